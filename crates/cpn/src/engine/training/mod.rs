//! Training: the outer loss of a batch, its gradient in every weight, and the update by it.

pub mod adam;
pub mod encoder_pass;
pub mod learner;
pub mod outer_loop;
pub mod outer_loss;
