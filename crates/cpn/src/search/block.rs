//! Interface of an engine to the searches: a rollout of g_θ, and a gradient step on its inner loss.

use super::query::Query;

/// Source of a rollout's actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Actions {
    /// Given actions.
    Given,
    /// Actions of the previous rollout after a gradient step. The first step has the same state again.
    Moved,
    /// Actions proposed by the policy at each predicted state.
    Proposed,
}

/// Purpose of a rollout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// The policy's actions; the state after the last action is not computed.
    Actions,
    /// The inner loss, without its gradient.
    Loss,
    /// The inner loss, and its gradient afterwards.
    Gradient,
}

/// A block of R plans with the memory of their rollouts by g_θ. A row's results do not depend on the other rows.
pub trait PlanBlock: Send {
    /// Maximum R.
    fn capacity(&self) -> usize;

    /// True if the method predicts the states after its actions, so that plans have an inner loss.
    fn is_searchable(&self) -> bool;

    /// Identity of the descent of the last rollout; `None` after any other rollout or change of the plans.
    fn resident(&mut self) -> &mut Option<u64>;

    /// The plan of row r of R = `rows`, `[H][A]`.
    fn plan(&self, rows: usize, r: usize) -> Vec<Vec<f32>>;

    /// Writes a plan, `[H][A]`, as row r of R = `rows`.
    fn set_plan(&mut self, rows: usize, r: usize, plan: &[Vec<f32>]);

    /// Rolls out from each query's x along the block's actions, or along proposed actions, which replace them. Returns the inner
    /// losses, `[R]`; undefined for [`Purpose::Actions`].
    fn roll_out(&mut self, queries: &[Query<'_>], source: Actions, purpose: Purpose) -> Vec<f32>;

    /// One gradient step of R = `rows` plans down the inner loss of the last rollout, which must have been for
    /// [`Purpose::Gradient`].
    fn descend(&mut self, rows: usize);
}
