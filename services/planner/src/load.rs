//! How much the model has to do, so that who would wait too long is told at once.

use crate::task::PlanTask;
use cpn::method::{Solver, rollouts};
use metrics::gauge;
use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use wire::planner::Search;

/// The newest measurement counts for so much in 1.
const WEIGHT: f64 = 0.1;
/// What is promised is a little longer than what is expected.
const CAUTION: f64 = 1.5;
/// Searches that take longer are done in pieces, between which others are planned for.
const LONG: Duration = Duration::from_millis(10);
/// How long a search in pieces keeps the model, at most, before it is looked at what waits.
pub(crate) const SLICE: Duration = Duration::from_millis(2);
/// Plans in a generation, if a request does not say.
const SAMPLES: u32 = 64;
/// Generations, likewise.
const GENERATIONS: u32 = 4;
/// Most iterations of a search that goes on until its deadline.
const MOST_ITERATIONS: usize = 1000;

/// Metric of the tasks that are not answered yet.
const QUEUE_DEPTH: &str = "cpn_planner_queue_depth";

/// Tasks that have been accepted and not answered, and what one takes.
#[derive(Debug, Default)]
pub(crate) struct Load {
    tasks: AtomicUsize,
    /// What the short ones of them are expected to take, in nanoseconds, and the long ones.
    short: AtomicU64,
    long: AtomicU64,
    searches: AtomicUsize,
    /// By the name of the model.
    costs: Mutex<HashMap<String, Costs>>,
    given_up: AtomicBool,
    /// Number of the answer that the models' thread is sending itself; 0 while it sends none.
    replying: AtomicU64,
    replies: AtomicU64,
    /// Threads that were sending one when another took over.
    stuck: AtomicUsize,
}

/// What the plans of a model cost, by kind of work. A rollout is as long as the model's horizon.
#[derive(Debug, Default, Clone)]
pub(crate) struct Costs {
    digest: String,
    updates: usize,
    /// To embed what a task brings along.
    embedding: Cost,
    /// A rollout, and back.
    descent: Cost,
    /// A rollout for its loss alone.
    trial: Cost,
}

/// Seconds for a piece of work; 0 if it was never measured.
#[derive(Debug, Default, Clone, Copy)]
struct Cost {
    likely: f64,
    least: f64,
}

/// What a task is expected to take.
#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct Estimate {
    pub(crate) likely: Duration,
    /// If everything goes as fast as it ever did.
    pub(crate) least: Duration,
    /// Whether it is done in pieces.
    pub(crate) long: bool,
}

/// Solver and iterations of a search, with what a request leaves open filled in.
pub(crate) fn resolve(search: Option<Search>, updates: usize) -> (Solver, usize) {
    let Some(Search { solver, iterations, samples, anytime }) = search else { return (Solver::Gradient, updates) };
    let samples = samples.unwrap_or(SAMPLES) as usize;
    let (solver, default) = match solver {
        wire::planner::Solver::Gradient => (Solver::Gradient, updates),
        wire::planner::Solver::Cem => (Solver::Cem(samples), GENERATIONS as usize),
        wire::planner::Solver::Mppi => (Solver::Mppi(samples), GENERATIONS as usize),
        wire::planner::Solver::Hybrid => (Solver::Hybrid(samples), GENERATIONS as usize),
    };
    (solver, if anytime { MOST_ITERATIONS } else { iterations.map_or(default, |count| count as usize) })
}

impl Cost {
    fn measure(&mut self, took: Duration, count: usize) {
        let one = took.as_secs_f64() / count as f64;
        self.likely = if self.likely == 0.0 { one } else { self.likely + WEIGHT * (one - self.likely) };
        self.least = if self.least == 0.0 { one } else { self.least.min(one) };
    }
}

impl Costs {
    /// Nothing is known yet of the plans of a checkpoint that makes so many updates.
    pub(crate) fn new(digest: &str, updates: usize) -> Self {
        Self { digest: digest.to_owned(), updates, ..Self::default() }
    }

    /// So many tasks were embedded together.
    pub(crate) fn embedded(&mut self, tasks: usize, took: Duration) {
        self.embedding.measure(took, tasks);
    }

    /// So many rollouts were made.
    pub(crate) fn rolled_out(&mut self, solver: Solver, rollouts: usize, took: Duration) {
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
        let likely = time(embedding.likely, one.likely);
        // What a search takes of which nothing is known may be anything.
        let long = task.is_anytime() || likely > LONG || task.search.is_some() && one.likely == 0.0;
        Estimate { likely, least: time(embedding.least, one.least), long }
    }
}

impl Load {
    /// A task has been accepted.
    pub(crate) fn begin(&self, estimate: Estimate) {
        self.tasks.fetch_add(1, Ordering::SeqCst);
        self.of(estimate).fetch_add(nanoseconds(estimate), Ordering::Relaxed);
        self.searches.fetch_add(usize::from(estimate.long), Ordering::Relaxed);
        gauge!(QUEUE_DEPTH).increment(1);
    }

    /// A task has been answered, or given up.
    pub(crate) fn end(&self, estimate: Estimate) {
        self.tasks.fetch_sub(1, Ordering::Relaxed);
        self.of(estimate).fetch_sub(nanoseconds(estimate), Ordering::Relaxed);
        self.searches.fetch_sub(usize::from(estimate.long), Ordering::Relaxed);
        gauge!(QUEUE_DEPTH).decrement(1);
    }

    fn of(&self, estimate: Estimate) -> &AtomicU64 {
        if estimate.long { &self.long } else { &self.short }
    }

    /// Tasks that are not answered yet.
    pub(crate) fn tasks(&self) -> usize {
        self.tasks.load(Ordering::SeqCst)
    }

    /// The models' thread sends an answer itself from now on.
    pub(crate) fn begin_reply(&self) -> u64 {
        let reply = self.replies.fetch_add(1, Ordering::Relaxed) + 1;
        self.replying.store(reply, Ordering::SeqCst);
        reply
    }

    /// The answer is sent; false if another thread has taken over in the meantime.
    pub(crate) fn end_reply(&self, reply: u64) -> bool {
        let leads = self.replying.compare_exchange(reply, 0, Ordering::SeqCst, Ordering::SeqCst).is_ok();
        if !leads {
            self.stuck.fetch_sub(1, Ordering::SeqCst);
        }
        leads
    }

    /// The answer that is being sent.
    pub(crate) fn replying(&self) -> Option<u64> {
        Some(self.replying.load(Ordering::SeqCst)).filter(|reply| *reply != 0)
    }

    /// Whether another thread may take over, as this answer is still being sent.
    pub(crate) fn take_over(&self, reply: u64) -> bool {
        let stuck = self.replying.compare_exchange(reply, 0, Ordering::SeqCst, Ordering::SeqCst).is_ok();
        if stuck {
            self.stuck.fetch_add(1, Ordering::SeqCst);
        }
        stuck
    }

    /// Whether an answer that was taken over from is still being sent.
    pub(crate) fn has_stuck(&self) -> bool {
        self.stuck.load(Ordering::SeqCst) > 0
    }

    /// What a task would take by itself.
    pub(crate) fn estimate(&self, task: &PlanTask) -> Estimate {
        let unknown = Estimate { long: task.search.is_some(), ..Estimate::default() };
        self.costs().get_mut(&task.model).map_or(unknown, |costs| costs.estimate(task))
    }

    /// When such a task would be answered, with what has been accepted before it.
    pub(crate) fn wait(&self, estimate: Estimate) -> Duration {
        let (short, long) = (&self.short, &self.long);
        let [short, long] = [short, long].map(|time| Duration::from_nanos(time.load(Ordering::Relaxed)));
        let searches = self.searches.load(Ordering::Relaxed) as u32;
        let wait = match (estimate.long, searches) {
            // Searches in pieces take turns.
            (true, _) => short + estimate.likely + long.min(estimate.likely * searches),
            (false, 0) => short + estimate.likely,
            // Half of the time is theirs.
            (false, _) => 2 * (short + estimate.likely) + SLICE,
        };
        wait.mul_f64(CAUTION)
    }

    /// How long a task may take.
    pub(crate) fn time(estimate: Estimate) -> Duration {
        estimate.likely.mul_f64(CAUTION)
    }

    /// What is known of a model that is to be served.
    pub(crate) fn learn(&self, model: &str, costs: Costs) {
        let mut known = self.costs();
        if known.get(model).is_none_or(|known| known.digest != costs.digest) {
            known.insert(model.to_owned(), costs);
        }
    }

    /// Adds measurements to what is known of a model.
    pub(crate) fn measure(&self, model: &str, measure: impl FnOnce(&mut Costs)) {
        if let Some(costs) = self.costs().get_mut(model) {
            measure(costs);
        }
    }

    /// A model is no longer served.
    pub(crate) fn forget(&self, model: &str) {
        self.costs().remove(model);
    }

    /// Nobody waits for searches any more.
    pub(crate) fn give_up(&self) {
        self.given_up.store(true, Ordering::Relaxed);
    }

    pub(crate) fn is_given_up(&self) -> bool {
        self.given_up.load(Ordering::Relaxed)
    }

    fn costs(&self) -> MutexGuard<'_, HashMap<String, Costs>> {
        self.costs.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn nanoseconds(estimate: Estimate) -> u64 {
    u64::try_from(estimate.likely.as_nanos()).unwrap_or(u64::MAX)
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
            span: Span::none(),
        }
    }

    fn cem(iterations: u32, samples: u32) -> Option<Search> {
        let (iterations, samples) = (Some(iterations), Some(samples));
        Some(Search { solver: wire::planner::Solver::Cem, iterations, samples, anytime: false })
    }

    /// A model that embeds in a millisecond, updates in two and tries a plan in a tenth of one.
    fn load() -> Load {
        let load = Load::default();
        let mut costs = Costs::new("digest", 1);
        costs.embedded(2, 2 * MS);
        costs.rolled_out(Solver::Gradient, 2, 4 * MS);
        costs.rolled_out(Solver::Cem(9), 10, MS);
        load.learn("cpn", costs);
        load
    }

    #[test]
    fn estimates_follow_what_is_asked_for() {
        let load = load();
        let estimate = |search| load.estimate(&task(search));
        let in_ms = |time: Duration| (time.as_secs_f64() * 1e3).round();
        assert_eq!((in_ms(estimate(None).likely), estimate(None).long), (5.0, false));
        assert_eq!((in_ms(estimate(cem(2, 10)).likely), estimate(cem(2, 10)).long), (3.0, false));
        assert_eq!((in_ms(estimate(cem(1000, 100)).likely), estimate(cem(1000, 100)).long), (10_001.0, true));
        let anytime = Search { anytime: true, ..cem(1000, 100).expect("a search") };
        assert!(estimate(Some(anytime)).long);
    }

    #[test]
    fn a_long_search_spoils_no_other_estimate() {
        let load = load();
        let (plain, long) = (load.estimate(&task(None)), load.estimate(&task(cem(1000, 4096))));
        load.begin(long);
        let beside = load.wait(plain);
        assert!(beside < Duration::from_millis(25), "{beside:?}: others wait for a piece of it, not for all");
        load.measure("cpn", |costs| costs.rolled_out(Solver::Cem(4096), 1000, 1000 * MS));
        load.end(long);
        assert_eq!(load.estimate(&task(None)).likely, plain.likely);
        assert_eq!(load.wait(plain), plain.likely.mul_f64(CAUTION));
        // A slow minute does not make impossible what was possible before.
        assert_eq!(load.estimate(&task(cem(1000, 4096))).least, long.least);
        assert!(load.estimate(&task(cem(1000, 4096))).likely > long.likely);
    }
}
