//! Admission control: estimates of compute times and waits, so that a request that would miss its deadline is refused at once.

use crate::task::PlanTask;
use cpn::method::{Solver, rollouts};
use metrics::gauge;
use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use wire::planner::Search;

/// Weight of the newest measurement in the moving average.
const EWMA_WEIGHT: f64 = 0.1;
/// Safety factor on estimated times.
const SAFETY_FACTOR: f64 = 1.5;
/// Estimated time above which a search is sliced, so that other plans run in between.
const LONG: Duration = Duration::from_millis(10);
/// Time slice of a sliced search.
pub(crate) const SLICE: Duration = Duration::from_millis(2);
/// Default number of samples per iteration.
const DEFAULT_SAMPLES: u32 = 64;
/// Default number of iterations of a sampling search.
const DEFAULT_ITERATIONS: u32 = 4;
/// Maximum number of iterations of an anytime search.
const MAX_ANYTIME_ITERATIONS: usize = 1000;

/// Metric of the accepted, unanswered tasks.
const QUEUE_DEPTH: &str = "cpn_planner_queue_depth";

/// Accepted, unanswered tasks, and measured compute times of the models.
#[derive(Debug, Default)]
pub(crate) struct Load {
    tasks: AtomicUsize,
    /// Expected time of all short tasks, in nanoseconds.
    short: AtomicU64,
    /// Expected time of all sliced searches, in nanoseconds.
    long: AtomicU64,
    /// Number of sliced searches.
    searches: AtomicUsize,
    /// Compute times, by the name of the model.
    costs: Mutex<HashMap<String, Costs>>,
    aborted: AtomicBool,
    /// Number of the reply that the model thread is sending itself; 0 while it sends none.
    replying: AtomicU64,
    replies: AtomicU64,
    /// Number of threads that were blocked in a reply when another took over the models.
    blocked: AtomicUsize,
}

/// Measured compute times of a model's plans, by kind of work. A rollout is as long as the model's horizon.
#[derive(Debug, Default, Clone)]
pub(crate) struct Costs {
    digest: String,
    updates: usize,
    /// Embedding of a task's observation and goal.
    embedding: Cost,
    /// Rollout with its backward pass.
    descent: Cost,
    /// Rollout without backward pass, for its loss.
    trial: Cost,
}

/// Compute time of one piece of work, in seconds; 0 before the first measurement.
#[derive(Debug, Default, Clone, Copy)]
struct Cost {
    /// Exponentially weighted moving average.
    expected: f64,
    minimum: f64,
}

/// Estimated compute time of a task.
#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct Estimate {
    pub(crate) expected: Duration,
    /// Time at the fastest speed ever measured.
    pub(crate) minimum: Duration,
    /// Whether the search is sliced.
    pub(crate) is_long: bool,
}

/// Solver and number of iterations of a search, with defaults filled in.
pub(crate) fn resolve(search: Option<Search>, updates: usize) -> (Solver, usize) {
    let Some(Search { solver, iterations, samples, anytime }) = search else { return (Solver::Gradient, updates) };
    let samples = samples.unwrap_or(DEFAULT_SAMPLES) as usize;
    let (solver, default) = match solver {
        wire::planner::Solver::Gradient => (Solver::Gradient, updates),
        wire::planner::Solver::Cem => (Solver::Cem(samples), DEFAULT_ITERATIONS as usize),
        wire::planner::Solver::Mppi => (Solver::Mppi(samples), DEFAULT_ITERATIONS as usize),
        wire::planner::Solver::Hybrid => (Solver::Hybrid(samples), DEFAULT_ITERATIONS as usize),
    };
    (solver, if anytime { MAX_ANYTIME_ITERATIONS } else { iterations.map_or(default, |count| count as usize) })
}

impl Cost {
    fn measure(&mut self, took: Duration, count: usize) {
        let one = took.as_secs_f64() / count as f64;
        self.expected = if self.expected == 0.0 { one } else { self.expected + EWMA_WEIGHT * (one - self.expected) };
        self.minimum = if self.minimum == 0.0 { one } else { self.minimum.min(one) };
    }
}

impl Costs {
    /// Costs of a checkpoint with `updates` gradient updates per plan, before any measurement.
    pub(crate) fn new(digest: &str, updates: usize) -> Self {
        Self { digest: digest.to_owned(), updates, ..Self::default() }
    }

    /// Records the time of embedding `tasks` tasks in one batch.
    pub(crate) fn record_embedding(&mut self, tasks: usize, took: Duration) {
        self.embedding.measure(took, tasks);
    }

    /// Records the time of `rollouts` rollouts.
    pub(crate) fn record_rollouts(&mut self, solver: Solver, rollouts: usize, took: Duration) {
        if rollouts > 0 {
            self.of(solver).measure(took, rollouts);
        }
    }

    fn of(&mut self, solver: Solver) -> &mut Cost {
        if solver == Solver::Gradient { &mut self.descent } else { &mut self.trial }
    }

    fn estimate(&mut self, task: &PlanTask) -> Estimate {
        let (solver, iterations) = resolve(task.search, self.updates);
        let count = rollouts(solver, if task.is_anytime() { 0 } else { iterations });
        let (embedding, one) = (self.embedding, *self.of(solver));
        let time = |embedding: f64, one: f64| Duration::from_secs_f64(embedding + one * count as f64);
        let expected = time(embedding.expected, one.expected);
        // A search that was never measured may take any time.
        let is_long = task.is_anytime() || expected > LONG || task.search.is_some() && one.expected == 0.0;
        Estimate { expected, minimum: time(embedding.minimum, one.minimum), is_long }
    }
}

impl Load {
    /// Counts an accepted task.
    pub(crate) fn begin(&self, estimate: Estimate) {
        self.tasks.fetch_add(1, Ordering::SeqCst);
        self.of(estimate).fetch_add(nanoseconds(estimate), Ordering::Relaxed);
        self.searches.fetch_add(usize::from(estimate.is_long), Ordering::Relaxed);
        gauge!(QUEUE_DEPTH).increment(1);
    }

    /// Removes a task that was answered or cancelled.
    pub(crate) fn end(&self, estimate: Estimate) {
        self.tasks.fetch_sub(1, Ordering::Relaxed);
        self.of(estimate).fetch_sub(nanoseconds(estimate), Ordering::Relaxed);
        self.searches.fetch_sub(usize::from(estimate.is_long), Ordering::Relaxed);
        gauge!(QUEUE_DEPTH).decrement(1);
    }

    fn of(&self, estimate: Estimate) -> &AtomicU64 {
        if estimate.is_long { &self.long } else { &self.short }
    }

    /// Number of accepted, unanswered tasks.
    pub(crate) fn tasks(&self) -> usize {
        self.tasks.load(Ordering::SeqCst)
    }

    /// Marks the begin of a reply by the model thread itself; returns its number.
    pub(crate) fn begin_reply(&self) -> u64 {
        let reply = self.replies.fetch_add(1, Ordering::Relaxed) + 1;
        self.replying.store(reply, Ordering::SeqCst);
        reply
    }

    /// Marks the end of a reply; false if another thread has taken over in the meantime.
    pub(crate) fn end_reply(&self, reply: u64) -> bool {
        let leads = self.replying.compare_exchange(reply, 0, Ordering::SeqCst, Ordering::SeqCst).is_ok();
        if !leads {
            self.blocked.fetch_sub(1, Ordering::SeqCst);
        }
        leads
    }

    /// Number of the reply being sent.
    pub(crate) fn replying(&self) -> Option<u64> {
        Some(self.replying.load(Ordering::SeqCst)).filter(|reply| *reply != 0)
    }

    /// Takes over from the thread that is sending this reply; false if it is no longer sending it.
    pub(crate) fn take_over(&self, reply: u64) -> bool {
        let stuck = self.replying.compare_exchange(reply, 0, Ordering::SeqCst, Ordering::SeqCst).is_ok();
        if stuck {
            self.blocked.fetch_add(1, Ordering::SeqCst);
        }
        stuck
    }

    /// Whether a thread that was taken over from is still blocked in its reply.
    pub(crate) fn has_blocked_reply(&self) -> bool {
        self.blocked.load(Ordering::SeqCst) > 0
    }

    /// Compute time of a task by itself.
    pub(crate) fn estimate(&self, task: &PlanTask) -> Estimate {
        let unknown = Estimate { is_long: task.search.is_some(), ..Estimate::default() };
        self.costs().get_mut(&task.model).map_or(unknown, |costs| costs.estimate(task))
    }

    /// Estimated time until such a task is answered, behind the tasks accepted before it, with the safety factor.
    pub(crate) fn wait(&self, estimate: Estimate) -> Duration {
        let (short, long) = (&self.short, &self.long);
        let [short, long] = [short, long].map(|time| Duration::from_nanos(time.load(Ordering::Relaxed)));
        let searches = self.searches.load(Ordering::Relaxed) as u32;
        let wait = match (estimate.is_long, searches) {
            // Sliced searches take turns.
            (true, _) => short + estimate.expected + long.min(estimate.expected * searches),
            (false, 0) => short + estimate.expected,
            // Sliced searches get half of the time.
            (false, _) => 2 * (short + estimate.expected) + SLICE,
        };
        wait.mul_f64(SAFETY_FACTOR)
    }

    /// Estimated compute time of a task, with the safety factor.
    pub(crate) fn bound(estimate: Estimate) -> Duration {
        estimate.expected.mul_f64(SAFETY_FACTOR)
    }

    /// Registers the costs of a served model, unless those of the same checkpoint are known.
    pub(crate) fn register(&self, model: &str, costs: Costs) {
        let mut known = self.costs();
        if known.get(model).is_none_or(|known| known.digest != costs.digest) {
            known.insert(model.to_owned(), costs);
        }
    }

    /// Adds measurements to the costs of a model.
    pub(crate) fn measure(&self, model: &str, measure: impl FnOnce(&mut Costs)) {
        if let Some(costs) = self.costs().get_mut(model) {
            measure(costs);
        }
    }

    /// Removes the costs of a model that is no longer served.
    pub(crate) fn forget(&self, model: &str) {
        self.costs().remove(model);
    }

    /// Aborts all searches: they have no clients any more.
    pub(crate) fn abort(&self) {
        self.aborted.store(true, Ordering::Relaxed);
    }

    pub(crate) fn is_aborted(&self) -> bool {
        self.aborted.load(Ordering::Relaxed)
    }

    fn costs(&self) -> MutexGuard<'_, HashMap<String, Costs>> {
        self.costs.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn nanoseconds(estimate: Estimate) -> u64 {
    u64::try_from(estimate.expected.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use tracing::Span;
    use wire::{Observation, Position};

    const MS: Duration = Duration::from_millis(1);

    fn task(search: Option<Search>) -> PlanTask {
        let Ok(position) = Position::new([0.0; 3]) else { unreachable!("the origin") };
        let observation = Observation::Position(position);
        PlanTask {
            model: "cpn".into(),
            model_digest: None,
            goal_id: String::new(),
            goal: Arc::new(observation.clone()),
            goal_field: "goal_id",
            observation,
            seed: 0,
            deadline: None,
            search,
            warm_start: Vec::new(),
            steps_left: None,
            approach: None,
            span: Span::none(),
        }
    }

    fn cem(iterations: u32, samples: u32) -> Option<Search> {
        let (iterations, samples) = (Some(iterations), Some(samples));
        Some(Search { solver: wire::planner::Solver::Cem, iterations, samples, anytime: false })
    }

    /// Load of a model that embeds in 1 ms, updates in 2 ms and rolls out a sample in 0.1 ms.
    fn load() -> Load {
        let load = Load::default();
        let mut costs = Costs::new("digest", 1);
        costs.record_embedding(2, 2 * MS);
        costs.record_rollouts(Solver::Gradient, 2, 4 * MS);
        costs.record_rollouts(Solver::Cem(9), 10, MS);
        load.register("cpn", costs);
        load
    }

    #[test]
    fn estimates_depend_on_the_search() {
        let load = load();
        let estimate = |search| load.estimate(&task(search));
        let in_ms = |time: Duration| (time.as_secs_f64() * 1e3).round();
        assert_eq!((in_ms(estimate(None).expected), estimate(None).is_long), (5.0, false));
        assert_eq!((in_ms(estimate(cem(2, 10)).expected), estimate(cem(2, 10)).is_long), (3.0, false));
        assert_eq!((in_ms(estimate(cem(1000, 100)).expected), estimate(cem(1000, 100)).is_long), (10_001.0, true));
        let anytime = Search { anytime: true, ..cem(1000, 100).expect("a search") };
        assert!(estimate(Some(anytime)).is_long);
    }

    #[test]
    fn a_long_search_leaves_other_estimates_unchanged() {
        let load = load();
        let (plain, long) = (load.estimate(&task(None)), load.estimate(&task(cem(1000, 4096))));
        load.begin(long);
        let beside = load.wait(plain);
        assert!(beside < Duration::from_millis(25), "{beside:?}: others wait for a piece of it, not for all");
        load.measure("cpn", |costs| costs.record_rollouts(Solver::Cem(4096), 1000, 1000 * MS));
        load.end(long);
        assert_eq!(load.estimate(&task(None)).expected, plain.expected);
        assert_eq!(load.wait(plain), plain.expected.mul_f64(SAFETY_FACTOR));
        // Slow measurements do not raise the minimum.
        assert_eq!(load.estimate(&task(cem(1000, 4096))).minimum, long.minimum);
        assert!(load.estimate(&task(cem(1000, 4096))).expected > long.expected);
    }
}
