//! Updates down the inner loss, for a block of plans at a time.

use super::inner::{Actions, Purpose};
use super::planner::{Dynamics, Worker};
use crate::method::{Plan, Query};
use std::sync::atomic::{AtomicU64, Ordering};

/// A descent for R plans, at most [`BLOCK`](super::planner::BLOCK). It can be left after any update and taken up again.
#[derive(Debug)]
pub(crate) struct Descent {
    /// What it is told apart by.
    id: u64,
    pub(crate) plans: Vec<Plan>,
    /// Updates that were made.
    pub(crate) done: usize,
    /// Actions after the last of them, `[R][H][A]`, while the worker's memory is somebody else's.
    left: Option<Vec<Vec<Vec<f32>>>>,
}

impl Descent {
    /// Rolls out from the policy's actions or the queries' own, which are all of one sort.
    pub(super) fn begin(worker: &mut Worker<f32>, dynamics: &Dynamics<f32>, queries: &[Query<'_>]) -> Self {
        let rows = queries.len();
        let source = if queries[0].start.is_empty() { Actions::Proposed } else { Actions::Given };
        for (r, query) in queries.iter().enumerate() {
            worker.set_plan(dynamics, rows, r, query.start);
        }
        let purpose = if dynamics.plans { Purpose::Gradient } else { Purpose::Actions };
        let losses: Vec<f32> = worker.roll_out(dynamics, (source, purpose), ends(queries)).collect();
        let begun = |(r, loss)| {
            let inner_losses = if dynamics.plans { vec![loss] } else { Vec::new() };
            Plan { actions: worker.plan(dynamics, rows, r), inner_losses, iterations: 0 }
        };
        Self { id: new_id(), plans: losses.into_iter().enumerate().map(begun).collect(), done: 0, left: None }
    }

    /// Makes one update, for a method that plans; whether it is the `last`, as far as is known, and whether the best plan
    /// counts or the last.
    pub(super) fn update(
        &mut self,
        worker: &mut Worker<f32>,
        dynamics: &Dynamics<f32>,
        queries: &[Query<'_>],
        (last, keep_best): (bool, bool),
    ) {
        let rows = queries.len();
        if rows == 0 {
            self.done += 1;
            return;
        }
        let left = self.left.take().filter(|_| worker.resident != Some(self.id));
        if let Some(left) = left {
            // The gradient needs what the rollout of these actions left in memory; it comes out the same again.
            for (r, plan) in left.iter().enumerate() {
                worker.set_plan(dynamics, rows, r, plan);
            }
            worker.roll_out(dynamics, (Actions::Given, Purpose::Gradient), ends(queries)).for_each(drop);
        }
        self.done += 1;
        worker.descend(dynamics, rows);
        let purpose = if last { Purpose::Loss } else { Purpose::Gradient };
        let losses: Vec<f32> = worker.roll_out(dynamics, (Actions::Moved, purpose), ends(queries)).collect();
        for (r, (plan, loss)) in self.plans.iter_mut().zip(losses).enumerate() {
            let best = plan.inner_losses[plan.inner_losses.len() - 1];
            let better = loss < best || !keep_best;
            if better {
                plan.actions = worker.plan(dynamics, rows, r);
                plan.iterations = self.done;
            }
            plan.inner_losses.push(if better { loss } else { best });
        }
    }

    /// Takes what the next update needs out of the worker's memory.
    pub(super) fn leave(&mut self, worker: &mut Worker<f32>, dynamics: &Dynamics<f32>) {
        // What was left already may not be in the memory any more.
        if self.left.is_none() {
            let rows = self.plans.len();
            self.left = Some((0..rows).map(|r| worker.plan(dynamics, rows, r)).collect());
            worker.resident = Some(self.id);
        }
    }

    /// Leaves out a plan of a descent that was left.
    pub(crate) fn remove(&mut self, r: usize) {
        self.plans.remove(r);
        // The rollout in memory is one of all.
        self.id = new_id();
        self.left.as_mut().map(|left| left.remove(r));
    }
}

fn new_id() -> u64 {
    static IDS: AtomicU64 = AtomicU64::new(0);
    IDS.fetch_add(1, Ordering::Relaxed)
}

fn ends<'a>(queries: &'a [Query<'_>]) -> impl Iterator<Item = (&'a [f32], &'a [f32])> {
    queries.iter().map(|query| (query.x, query.x_g))
}
