//! How much the model has to do, so that who would wait too long is told at once.

use metrics::gauge;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

/// The newest measurement counts for so much in 1.
const WEIGHT: f64 = 0.1;
/// What is promised is a little longer than what is expected.
const CAUTION: f64 = 1.5;

/// Metric of the tasks that are not answered yet.
const QUEUE_DEPTH: &str = "cpn_planner_queue_depth";

/// Tasks that have been accepted and not answered, and what one takes.
#[derive(Debug, Default)]
pub(crate) struct Load {
    tasks: AtomicUsize,
    nanoseconds_per_task: AtomicU64,
}

impl Load {
    /// A task has been accepted.
    pub(crate) fn begin(&self) {
        self.tasks.fetch_add(1, Ordering::Relaxed);
        gauge!(QUEUE_DEPTH).increment(1);
    }

    /// Some tasks, done together, took so long.
    pub(crate) fn measure(&self, tasks: usize, took: Duration) {
        let one = took.as_nanos() as f64 / tasks as f64;
        let before = self.nanoseconds_per_task.load(Ordering::Relaxed) as f64;
        let now = if before == 0.0 { one } else { before + WEIGHT * (one - before) };
        self.nanoseconds_per_task.store(now as u64, Ordering::Relaxed);
    }

    /// A task has been answered, or given up.
    pub(crate) fn end(&self) {
        self.tasks.fetch_sub(1, Ordering::Relaxed);
        gauge!(QUEUE_DEPTH).decrement(1);
    }

    /// Tasks that are not answered yet.
    pub(crate) fn tasks(&self) -> usize {
        self.tasks.load(Ordering::Relaxed)
    }

    /// How long so many tasks may take.
    pub(crate) fn time(&self, tasks: usize) -> Duration {
        let one = Duration::from_nanos(self.nanoseconds_per_task.load(Ordering::Relaxed));
        one.mul_f64(CAUTION * tasks as f64)
    }
}
