//! Searches for plans, independent of the engine: g_θ is evaluated only by the rollouts of a [`PlanBlock`].

pub mod block;
pub(crate) mod descent;
pub(crate) mod ongoing;
mod query;
pub(crate) mod sampling;
pub mod searcher;

pub use block::PlanBlock;
pub use query::{Iterations, Plan, Query, Search, Solver, rollouts};
pub use searcher::Searcher;
