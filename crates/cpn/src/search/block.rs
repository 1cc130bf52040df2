//! The two steps that every search is made of: a rollout, and a step down its loss.

use super::query::Query;

/// Source of a rollout's actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Actions {
    /// Given actions.
    Given,
    /// The actions of the rollout before, moved down its loss: the first step sees the same state again.
    Moved,
    /// Actions that the policy proposes along the way.
    Proposed,
}

/// Purpose of a rollout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// The policy's actions; the state after the last is not computed.
    Actions,
    /// The inner loss alone.
    Loss,
    /// The inner loss, and its gradient afterwards.
    Gradient,
}

/// Memory for R plans with a rollout of g_θ over them. A row's numbers do not depend on the other rows.
pub trait PlanBlock: Send {
    /// Maximum R.
    fn capacity(&self) -> usize;

    /// True if the method predicts the states after its actions, so that there is a loss to search down.
    fn is_searchable(&self) -> bool;

    /// Identity of the descent that the last rollout belongs to; none after any other rollout or change of the plans.
    fn resident(&mut self) -> &mut Option<u64>;

    /// The plan of row r of R = `rows`, `[H][A]`.
    fn plan(&self, rows: usize, r: usize) -> Vec<Vec<f32>>;

    /// Writes a plan, `[H][A]`, as row r of R = `rows`.
    fn set_plan(&mut self, rows: usize, r: usize, plan: &[Vec<f32>]);

    /// Rolls out from each query's x along the block's actions, or along proposed ones, which it keeps; returns the inner losses,
    /// `[R]`, without meaning for [`Purpose::Actions`]. Only a rollout for its gradient can be descended by.
    fn roll_out(&mut self, queries: &[Query<'_>], source: Actions, purpose: Purpose) -> Vec<f32>;

    /// Moves the actions of the last rollout, of R = `rows` plans, a step down its inner loss.
    fn descend(&mut self, rows: usize);
}
