//! Contextual Planning Networks in libtorch.
//!
//! The reference: the paper's ideas, a file each, differentiated by autograd. [`encoder`] is f_φ, [`neuromodulated`] the layer with
//! attenuated weights, [`dynamics`] g_θ, the combined policy and dynamics; [`inner_loop`] plans, [`loss`] is that of the outer loop,
//! and [`agent`] puts them together for each of the compared methods. The native engine of the crate `cpn` is held to it.
//!
//! The engine, [`Torch`]: the same networks behind the interface of every [`Engine`](cpn::Engine), on any device of libtorch.

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
