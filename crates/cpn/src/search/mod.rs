//! Searches for plans. They know g_θ by the rollouts of a [`PlanBlock`] alone, whichever engine computes them.

pub mod block;
pub(crate) mod descent;
pub(crate) mod ongoing;
mod query;
pub(crate) mod sampling;
pub mod searcher;

pub use block::PlanBlock;
pub use query::{Iterations, Plan, Query, Search, Solver, rollouts};
pub use searcher::Searcher;
