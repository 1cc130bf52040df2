//! Planning: the rollout of g_θ and the searches over it.

pub mod descent;
pub mod ongoing;
pub mod planner;
pub mod rollout;
pub mod sampling_search;
pub mod worker;
