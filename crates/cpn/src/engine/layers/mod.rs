//! Layers, each with hand-derived passes over a block of R samples. The passes' arguments are defined in [`passes`].

pub mod conv2d;
pub mod conv2d_params;
pub mod dense;
pub mod layer_norm;
pub mod linear;
pub mod neuromodulated;
pub mod passes;
pub mod projection;
pub mod relu;
pub mod winograd;
pub mod winograd_transform;
