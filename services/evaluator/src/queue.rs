//! Which trials are still to be run: every model on the same variations.

use crate::record::Run;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use wire::sim::Variation;

/// Outages after which a trial may begin anew.
pub(crate) const MAX_OUTAGES: u32 = 5;
/// Faults of services after which a trial may begin anew.
pub(crate) const MAX_FAULTS: u32 = 1;

/// A trial to run.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Job {
    pub(crate) variation: Variation,
    /// Index of the model.
    pub(crate) model: usize,
    /// Outages that ended it before.
    pub(crate) outages: u32,
    /// Faults of services that ended it before.
    pub(crate) faults: u32,
}

impl Job {
    /// Whether it may begin anew after all that ended it before.
    pub(crate) fn may_begin_anew(&self) -> bool {
        self.outages <= MAX_OUTAGES && self.faults <= MAX_FAULTS
    }
}

/// Trials by task, so that a worker changes its task rarely.
#[derive(Debug)]
pub(crate) struct Queue {
    tasks: Vec<Task>,
    models: usize,
    /// Variations and models whose trial is there already.
    finished: BTreeSet<(Variation, usize)>,
}

#[derive(Debug)]
struct Task {
    name: String,
    jobs: VecDeque<Job>,
    /// Takes the place of the next seed that is skipped.
    next_seed: u64,
    skipped: BTreeSet<u64>,
}

impl Queue {
    /// Every model on so many seeds of every task, but for the trials that are finished and the seeds to be skipped.
    pub(crate) fn new(
        run: &Run,
        finished: BTreeSet<(Variation, usize)>,
        mut skipped: BTreeMap<String, BTreeSet<u64>>,
    ) -> Self {
        let task = |name: &String| Task {
            name: name.clone(),
            jobs: VecDeque::new(),
            next_seed: run.first_seed,
            skipped: skipped.remove(name).unwrap_or_default(),
        };
        let mut queue = Self { tasks: run.tasks.iter().map(task).collect(), models: run.models.len(), finished };
        for task in 0..run.tasks.len() {
            for _ in 0..run.trials {
                queue.push_seed(task);
            }
        }
        queue
    }

    /// Number of trials that wait.
    pub(crate) fn len(&self) -> usize {
        self.tasks.iter().map(|task| task.jobs.len()).sum()
    }

    /// The first variation that waits of each task.
    pub(crate) fn first_variations(&self) -> Vec<Variation> {
        self.tasks.iter().filter_map(|task| task.jobs.front()).map(|job| job.variation.clone()).collect()
    }

    /// The next trial: of the task the worker is at, or else of the task with the most left.
    pub(crate) fn next(&mut self, current: Option<&str>) -> Option<Job> {
        let left = |&task: &usize| self.tasks[task].jobs.len();
        let at_hand = self.tasks.iter().position(|task| Some(task.name.as_str()) == current && !task.jobs.is_empty());
        // Of equals, `max_by_key` takes the last.
        let task = at_hand.or_else(|| (0..self.tasks.len()).rev().max_by_key(left))?;
        self.tasks[task].jobs.pop_front()
    }

    /// Takes back a trial that is to begin anew, after the others of its task.
    pub(crate) fn retry(&mut self, job: Job) {
        if let Some(task) = self.tasks.iter_mut().find(|task| task.name == job.variation.task)
            && !task.skipped.contains(&job.variation.seed)
        {
            task.jobs.push_back(job);
        }
    }

    /// Replaces a variation by the next one, for all models alike.
    pub(crate) fn skip(&mut self, variation: &Variation) {
        let Some(index) = self.tasks.iter().position(|task| task.name == variation.task) else { return };
        let task = &mut self.tasks[index];
        if task.skipped.insert(variation.seed) {
            task.jobs.retain(|job| job.variation != *variation);
            self.push_seed(index);
        }
    }

    /// Whether the variation was replaced.
    pub(crate) fn is_skipped(&self, variation: &Variation) -> bool {
        self.tasks.iter().any(|task| task.name == variation.task && task.skipped.contains(&variation.seed))
    }

    /// Everything that waits.
    pub(crate) fn drain(&mut self) -> Vec<Job> {
        self.tasks.iter_mut().flat_map(|task| task.jobs.drain(..)).collect()
    }

    fn push_seed(&mut self, task: usize) {
        let task = &mut self.tasks[task];
        while task.skipped.contains(&task.next_seed) {
            task.next_seed += 1;
        }
        let variation = Variation { task: task.name.clone(), seed: task.next_seed };
        task.next_seed += 1;
        for model in 0..self.models {
            if !self.finished.contains(&(variation.clone(), model)) {
                task.jobs.push_back(Job { variation: variation.clone(), model, outages: 0, faults: 0 });
            }
        }
    }
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;
    use crate::planning::Planning;
    use crate::record::{FORMAT, GoalSource, Model};

    fn variation(task: &str, seed: u64) -> Variation {
        Variation { task: task.into(), seed }
    }

    fn run(tasks: &[&str], trials: u32) -> Run {
        let model = |name: &str| Model {
            name: name.into(),
            method: name.into(),
            digest: "0".repeat(64),
            training_tasks: Vec::new(),
            horizon: 1,
        };
        Run {
            format: FORMAT,
            title: String::new(),
            command: String::new(),
            date: String::new(),
            planners: vec!["planner".into()],
            models: vec![model("cpn"), model("random")],
            tasks: tasks.iter().map(ToString::to_string).collect(),
            trials,
            first_seed: 10,
            goal: GoalSource::SameVariation,
            planning: Planning::default(),
        }
    }

    fn queue(tasks: &[&str], trials: u32, finished: &[(&str, u64, usize)]) -> Queue {
        let finished = finished.iter().map(|&(task, seed, model)| (variation(task, seed), model)).collect();
        Queue::new(&run(tasks, trials), finished, BTreeMap::new())
    }

    fn seeds_and_models(queue: &mut Queue) -> Vec<(u64, usize)> {
        queue.drain().iter().map(|job| (job.variation.seed, job.model)).collect()
    }

    #[test]
    fn every_model_gets_the_same_seeds_and_a_skipped_one_is_replaced_for_all() {
        let mut queue = queue(&["reach"], 3, &[]);
        // Two workers find at once that the expert does not solve seed 10.
        let (first, second) = (queue.next(None).unwrap(), queue.next(None).unwrap());
        queue.skip(&first.variation);
        queue.skip(&second.variation);
        assert!(queue.is_skipped(&first.variation));
        assert_eq!(seeds_and_models(&mut queue), [(11, 0), (11, 1), (12, 0), (12, 1), (13, 0), (13, 1)]);
    }

    #[test]
    fn a_skipped_seed_leaves_with_the_trials_of_the_other_models() {
        let mut queue = queue(&["reach"], 2, &[]);
        let first = queue.next(None).unwrap();
        queue.skip(&first.variation);
        queue.retry(first);
        assert_eq!(seeds_and_models(&mut queue), [(11, 0), (11, 1), (12, 0), (12, 1)]);
    }

    #[test]
    fn seeds_skipped_by_an_earlier_run_are_not_tried_again() {
        let skipped = BTreeMap::from([("reach".into(), BTreeSet::from([10, 12, 13, 99]))]);
        let mut queue = Queue::new(&run(&["reach"], 2), BTreeSet::new(), skipped);
        assert_eq!(seeds_and_models(&mut queue), [(11, 0), (11, 1), (14, 0), (14, 1)]);
    }

    #[test]
    fn finished_trials_are_not_run_again() {
        let mut queue = queue(&["reach"], 2, &[("reach", 10, 0), ("reach", 11, 1), ("reach", 12, 0)]);
        assert_eq!(queue.len(), 2);
        // The seed that takes the place of a skipped one may be finished too.
        queue.skip(&variation("reach", 10));
        assert_eq!(seeds_and_models(&mut queue), [(11, 0), (12, 1)]);
    }

    #[test]
    fn a_worker_stays_at_its_task_and_then_goes_where_most_is_left() {
        let mut queue = queue(&["reach", "door-lock", "dial-turn"], 1, &[("dial-turn", 10, 0)]);
        let mut next = |current| queue.next(current).map(|job| job.variation.task);
        assert_eq!(next(None).as_deref(), Some("reach"));
        assert_eq!(next(None).as_deref(), Some("door-lock"));
        assert_eq!(next(Some("reach")).as_deref(), Some("reach"));
        assert_eq!(next(Some("door-lock")).as_deref(), Some("door-lock"));
        assert_eq!(next(Some("reach")).as_deref(), Some("dial-turn"));
        assert_eq!(next(Some("reach")), None);
    }

    #[test]
    fn a_trial_to_try_again_comes_last() {
        let mut queue = queue(&["reach"], 1, &[]);
        let first = queue.next(None).unwrap();
        queue.retry(first.clone());
        assert_eq!(queue.next(None).unwrap().model, 1);
        assert_eq!(queue.next(None).unwrap(), first);
    }

    #[test]
    fn a_trial_begins_anew_after_five_outages_and_one_fault() {
        let job = queue(&["reach"], 1, &[]).next(None).unwrap();
        let may = |outages, faults| Job { outages, faults, ..job.clone() }.may_begin_anew();
        assert!(may(5, 0) && may(0, 1) && may(5, 1));
        assert!(!may(6, 0) && !may(0, 2));
    }
}
