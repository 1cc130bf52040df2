//! Gradient descent on the inner loss, for a block of plans.

use super::block::{Actions, PlanBlock, Purpose};
use super::query::{Plan, Query};
use std::sync::atomic::{AtomicU64, Ordering};

/// Gradient descent of R plans, at most a block's capacity. It can be suspended after any update and resumed.
#[derive(Debug)]
pub struct Descent {
    /// Identity of the descent, which marks its rollout in a block's memory.
    id: u64,
    pub plans: Vec<Plan>,
    /// Number of updates so far.
    pub done: usize,
    /// Actions after the last update, `[R][H][A]`, while the block's memory is used by other searches.
    suspended: Option<Vec<Vec<Vec<f32>>>>,
}

impl Descent {
    /// The first rollout, from the policy's actions or from the queries' start; either all queries have a start or none.
    pub fn begin(block: &mut impl PlanBlock, queries: &[Query<'_>]) -> Self {
        let rows = queries.len();
        let source = if queries[0].start.is_empty() { Actions::Proposed } else { Actions::Given };
        for (r, query) in queries.iter().enumerate() {
            block.set_plan(rows, r, query.start);
        }

        let is_searchable = block.is_searchable();
        let purpose = if is_searchable { Purpose::Gradient } else { Purpose::Actions };
        let losses = block.roll_out(queries, source, purpose);
        let begun = |(r, loss)| {
            let inner_losses = if is_searchable { vec![loss] } else { Vec::new() };
            Plan { actions: block.plan(rows, r), inner_losses, iterations: 0 }
        };
        Self { id: new_id(), plans: losses.into_iter().enumerate().map(begun).collect(), done: 0, suspended: None }
    }

    /// One update, for a searchable method. `last`: no update follows, so that no gradient is needed. `keep_best`: the result is
    /// the best plan, else the last; in either case the initial one of a query that keeps it.
    pub fn update(&mut self, block: &mut impl PlanBlock, queries: &[Query<'_>], last: bool, keep_best: bool) {
        let rows = queries.len();
        if rows == 0 {
            self.done += 1;
            return;
        }

        let suspended = self.suspended.take().filter(|_| *block.resident() != Some(self.id));
        if let Some(suspended) = suspended {
            // The gradient needs the tapes of these actions' rollout: repeated, it gives equal values.
            for (r, plan) in suspended.iter().enumerate() {
                block.set_plan(rows, r, plan);
            }
            block.roll_out(queries, Actions::Given, Purpose::Gradient);
        }

        self.done += 1;
        block.descend(rows);
        let purpose = if last { Purpose::Loss } else { Purpose::Gradient };
        let losses = block.roll_out(queries, Actions::Moved, purpose);

        for (r, ((plan, query), loss)) in self.plans.iter_mut().zip(queries).zip(losses).enumerate() {
            let best = plan.inner_losses[plan.inner_losses.len() - 1];
            let better = !query.keep_initial && (loss < best || !keep_best);
            if better {
                plan.actions = block.plan(rows, r);
                plan.iterations = self.done;
            }
            plan.inner_losses.push(if better { loss } else { best });
        }
    }

    /// Copies the state of the next update out of the block's memory.
    pub fn suspend(&mut self, block: &mut impl PlanBlock) {
        // The block's memory may hold another search by now if this one was suspended before.
        if self.suspended.is_none() {
            let rows = self.plans.len();
            self.suspended = Some((0..rows).map(|r| block.plan(rows, r)).collect());
            *block.resident() = Some(self.id);
        }
    }

    /// Removes a plan of a suspended descent.
    pub fn remove(&mut self, r: usize) {
        self.plans.remove(r);
        // A new identity, since the rollout in memory includes the removed plan.
        self.id = new_id();
        self.suspended.as_mut().map(|suspended| suspended.remove(r));
    }
}

fn new_id() -> u64 {
    static IDS: AtomicU64 = AtomicU64::new(0);
    IDS.fetch_add(1, Ordering::Relaxed)
}
