//! Contextual Planning Networks: the method in pure Rust.
//!
//! The agent of "Visual goal-directed meta-learning with contextual planning networks" (Rivera and Handelman, 2021) gets one image
//! of a finished task and plans towards it in a learned latent space. A [`Model`] is the configuration and the weights of an image
//! encoder f_φ and of g_θ, the combined policy and dynamics network; a [`Checkpoint`](checkpoint::Checkpoint) is a model with its
//! provenance. An [`Engine`] computes a model's plans, as a [`Method`], and its training, as a [`Learner`]. The engine of this
//! crate, [`engine::Native`], runs hand-derived forward and backward passes on the processor; the crate `cpn-torch` has the
//! reference by autograd, and an engine for every device of libtorch.
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
//! | k | `steps_left` | scaled number of steps left to the goal, `[B]`; beside the paper |
//! | â_{t:t+H} | `Plan::actions` | planned actions, `[B, H, A]` |
//!
//! Files are validated once, in [`checkpoint::from_bytes`]; a wrong shape after that is a bug and panics.

mod approach;
pub mod archive;
mod batch;
pub mod checkpoint;
pub mod config;
pub mod engine;
mod familiar;
pub mod images;
pub mod learner;
pub mod method;
pub mod model;
mod observation;
pub mod positions;
mod precision;
pub mod recipe;
pub mod search;
pub mod steps_left;
mod unique;

pub use approach::Approach;
pub use batch::Batch;
pub use config::{EncoderConfig, Input, MethodKind, ModelConfig};
pub use engine::{Engine, Planner};
pub use familiar::FamiliarGoals;
pub use learner::Learner;
pub use method::{Frames, Method, Plan, Random};
pub use model::Model;
pub use precision::Precision;
pub use recipe::{Losses, Preset, Recipe, Training};
