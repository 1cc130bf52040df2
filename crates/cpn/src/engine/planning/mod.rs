//! Planning: rollouts of g_θ, and the planner, which searches over them.

pub mod planner;
pub mod rollout;
pub mod worker;
