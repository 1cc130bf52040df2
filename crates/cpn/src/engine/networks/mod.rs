//! Networks: encoder f_φ and policy dynamics network g_θ, with their passes.

pub mod encoder;
pub mod policy_dynamics;
pub mod position_dynamics;
mod weights;
