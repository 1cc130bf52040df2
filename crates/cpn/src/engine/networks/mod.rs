//! The networks: the encoder f_φ and the combined policy and dynamics g_θ, each with its passes.

pub mod encoder;
pub mod policy_dynamics;
mod weights;
