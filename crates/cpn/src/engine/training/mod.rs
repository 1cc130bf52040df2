//! Training: the outer loss of a batch and its gradient in every weight.

pub mod encoder_pass;
pub mod outer_loop;
pub mod outer_loss;
