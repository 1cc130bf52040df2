//! Contextual Planning Networks: the method itself, and nothing else.
//!
//! Visual goal-directed meta-learning with contextual planning networks (Rivera and Handelman, 2021) shows an agent one
//! image of a finished task and plans towards it in a learned latent space. The files of this crate are the paper's
//! ideas, one each: [`encoder`] (f_φ), [`neuromodulated`] (the layer with attenuated weights), [`dynamics`] (g_θ, the
//! combined policy and dynamics), [`inner_loop`], [`loss`] (the outer loop); [`agent`] puts them together for each of the
//! compared methods. [`engine`] does the same by hand-derived passes, without a graph: [`Planner`] serves an agent's plans, as a [`method`].
//!
//! | symbol | name here | meaning |
//! |---|---|---|
//! | B | batch | independent plans or samples |
//! | H | `horizon` | planned steps |
//! | U | `updates` | gradient updates of a plan |
//! | Z | `latent` | size of an embedding |
//! | A | `actions` | continuous actions of the robot |
//! | o_t, o_g | `observation`, `goal` | images, `[B, 84, 84, 3]`, 8 bits; or positions, `[B, 3]`, metres |
//! | x_t, x_g | `x`, `x_g` | their embeddings, `[B, Z]` |
//! | â_{t:t+H} | `Plan::actions` | planned actions, `[B, H, A]` |
//!
//! Tensors are validated once, where bytes become tensors ([`images`], [`positions`], [`checkpoint`]); past that edge a wrong
//! shape is a bug and `tch` panics.

pub mod agent;
pub mod archive;
pub mod checkpoint;
pub mod config;
pub mod dynamics;
pub mod encoder;
pub mod engine;
pub mod images;
pub mod inner_loop;
pub mod loss;
pub mod method;
pub mod neuromodulated;
mod observation;
pub mod positions;
mod precision;
pub mod recipe;
mod search;
mod unique;

pub use agent::Agent;
pub use config::{EncoderConfig, Input, MethodKind, ModelConfig};
pub use engine::Planner;
pub use method::{Frames, Method, Plan, Random};
pub use recipe::{Preset, Recipe, Training};
