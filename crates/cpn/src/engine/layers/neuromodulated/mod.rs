//! The neuromodulated layer: [weights that a gate attenuates](gated_weights) for each sample, put together in [`layer`].

pub mod block_sparse;
pub mod gate;
pub mod gated_weights;
pub mod kernels;
pub mod layer;
