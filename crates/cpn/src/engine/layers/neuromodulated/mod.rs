//! Neuromodulated layer: [gated weights](gated_weights), with their gates and kernels, combined in [`layer`].

pub mod block_sparse;
pub mod gate;
pub mod gated_weights;
pub mod kernels;
pub mod layer;
