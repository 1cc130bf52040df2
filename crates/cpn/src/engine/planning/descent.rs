//! Gradient descent down the inner loss, for a block of plans at a time.

use super::rollout::{Actions, Purpose};
use super::worker::{Dynamics, Worker};
use crate::search::{Plan, Query};
use std::sync::atomic::{AtomicU64, Ordering};

/// A descent for R plans, at most [`BLOCK`](super::worker::BLOCK). It can be suspended after any update and resumed.
#[derive(Debug)]
pub struct Descent {
    /// Identity of the descent, by which it finds its rollout in a worker's memory.
    id: u64,
    pub plans: Vec<Plan>,
    /// Number of updates that were made.
    pub done: usize,
    /// Actions after the last update, `[R][H][A]`, while the worker's memory serves others.
    suspended: Option<Vec<Vec<Vec<f32>>>>,
}

impl Descent {
    /// The first rollout, from the policy's actions or from the queries' own; either all queries have some or none.
    pub fn begin(worker: &mut Worker<f32>, dynamics: &Dynamics<f32>, queries: &[Query<'_>]) -> Self {
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
        Self { id: new_id(), plans: losses.into_iter().enumerate().map(begun).collect(), done: 0, suspended: None }
    }

    /// One update, for a method that plans: `last` if it is known that none follows; with `keep_best` the best plan counts, else
    /// the last.
    pub fn update(
        &mut self,
        worker: &mut Worker<f32>,
        dynamics: &Dynamics<f32>,
        queries: &[Query<'_>],
        last: bool,
        keep_best: bool,
    ) {
        let rows = queries.len();
        if rows == 0 {
            self.done += 1;
            return;
        }

        let suspended = self.suspended.take().filter(|_| worker.resident != Some(self.id));
        if let Some(suspended) = suspended {
            // The gradient needs the tapes of these actions' rollout; it comes out the same again.
            for (r, plan) in suspended.iter().enumerate() {
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

    /// Copies the state of the next update out of the worker's memory.
    pub fn suspend(&mut self, worker: &mut Worker<f32>, dynamics: &Dynamics<f32>) {
        // A descent that is suspended already may have nothing in the memory any more.
        if self.suspended.is_none() {
            let rows = self.plans.len();
            self.suspended = Some((0..rows).map(|r| worker.plan(dynamics, rows, r)).collect());
            worker.resident = Some(self.id);
        }
    }

    /// Removes a plan of a suspended descent.
    pub fn remove(&mut self, r: usize) {
        self.plans.remove(r);
        // The rollout in memory is one of all.
        self.id = new_id();
        self.suspended.as_mut().map(|suspended| suspended.remove(r));
    }
}

fn new_id() -> u64 {
    static IDS: AtomicU64 = AtomicU64::new(0);
    IDS.fetch_add(1, Ordering::Relaxed)
}

fn ends<'a>(queries: &'a [Query<'_>]) -> impl Iterator<Item = (&'a [f32], &'a [f32])> {
    queries.iter().map(|query| (query.x, query.x_g))
}
