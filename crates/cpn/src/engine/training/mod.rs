//! Training: the outer loss of a batch, its gradient in all weights, and the optimiser.

pub mod adam;
pub mod dynamics_loss;
pub mod encoder_pass;
pub mod learner;
pub mod outer_loop;
pub mod outer_loss;
pub mod samples;
