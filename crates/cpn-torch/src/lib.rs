//! Contextual Planning Networks in libtorch.
//!
//! The reference: one file for each part of the method, differentiated by autograd. [`encoder`] is f_φ, [`neuromodulated`] the
//! layer with attenuated weights, [`dynamics`] the policy dynamics network g_θ, [`inner_loop`] the planning, [`loss`] the outer
//! loss, and [`agent`] their combination for each of the compared methods. The tests compare the native engine of the crate `cpn`
//! with it.
//!
//! The engine, [`Torch`]: the same networks behind the interface [`Engine`](cpn::Engine), on any device of libtorch.

pub mod agent;
pub mod dynamics;
pub mod encoder;
mod engine;
pub mod inner_loop;
mod learner;
pub mod loss;
pub mod neuromodulated;
mod planner;
pub mod tensors;

pub use agent::Agent;
pub use engine::Torch;
