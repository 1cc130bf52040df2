//! Planning: the rollout of g_θ, and the planner that searches over it.

pub mod planner;
pub mod rollout;
pub mod worker;
