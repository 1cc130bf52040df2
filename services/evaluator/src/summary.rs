//! Success rates and their confidence intervals.

use crate::record::{Model, Outcome, Run, Trial};
use serde::Serialize;
use sha2::{Digest, Sha256};
use statrs::distribution::{ContinuousCDF, Normal};
use std::collections::{BTreeMap, BTreeSet};

/// Confidence of the intervals.
pub(crate) const CONFIDENCE: f64 = 0.95;

/// Results of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Description of the run.
    pub run: Run,
    /// Method of the intervals.
    pub interval_method: &'static str,
    /// Their confidence.
    pub confidence: f64,
    /// Whether models may have been trained on the very variations: the seeds are those of demonstrations.
    pub demonstration_seeds: bool,
    /// Seeds of the variations with a record, by task.
    pub seeds: BTreeMap<String, BTreeSet<u64>>,
    /// SHA-256 of these, in hex: of a line `TASK SEED` for each, in that order.
    pub seeds_digest: String,
    /// One for each task and model, in the run's order.
    pub rows: Vec<Row>,
}

/// One model at one task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// The task.
    pub task: String,
    /// Name of the model.
    pub model: String,
    /// Whether the model was trained on the task.
    pub training: Training,
    /// Trials that succeeded.
    pub successes: usize,
    /// Trials that succeeded or failed.
    pub trials: usize,
    /// Trials that were no attempt, because the task was solved before any action; in neither of the above.
    pub solved_at_reset: usize,
    /// Trials that were not brought to an end.
    pub errors: usize,
    /// Message of the first error, if any.
    pub first_error: Option<String>,
    /// Share of the trials that succeeded.
    pub rate: Option<f64>,
    /// Wilson score interval of the rate.
    pub interval: Option<(f64, f64)>,
    /// Mean number of steps of the successes.
    pub mean_success_steps: Option<f64>,
    /// Mean over the trials of the greatest progress towards success, 0 to 1; none if it was not measured.
    pub mean_best_progress: Option<f64>,
    /// The same of the progress at the end.
    pub mean_final_progress: Option<f64>,
}

/// Whether a model was trained on a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Training {
    /// It was.
    Trained,
    /// It was not: first attempts at it are zero-shot.
    HeldOut,
    /// It was trained on nothing.
    None,
}

impl Training {
    /// Label in tables.
    pub fn label(self) -> &'static str {
        match self {
            Self::Trained => "trained",
            Self::HeldOut => "held out",
            Self::None => "–",
        }
    }
}

impl Summary {
    /// Counts trials of a run.
    pub fn new(run: Run, trials: &[Trial]) -> Self {
        let row = |task: &str, model: &Model| {
            let trials = trials.iter().filter(|trial| trial.task == task && trial.model == model.name);
            Row::new(task, model, trials)
        };
        let rows = run.tasks.iter().flat_map(|task| run.models.iter().map(move |model| row(task, model))).collect();
        let demonstration_seeds = run.has_demonstration_seeds();
        let (seeds, interval_method) = (seeds(trials), "Wilson score");
        let seeds_digest = seeds_digest(&seeds);
        Self { run, demonstration_seeds, seeds, seeds_digest, interval_method, confidence: CONFIDENCE, rows }
    }

    /// Trials that were no attempt.
    pub fn solved_at_reset(&self) -> usize {
        self.rows.iter().map(|row| row.solved_at_reset).sum()
    }

    /// Trials that were not brought to an end.
    pub fn errors(&self) -> usize {
        self.rows.iter().map(|row| row.errors).sum()
    }
}

impl Row {
    fn new<'a>(task: &str, model: &Model, of_row: impl Iterator<Item = &'a Trial>) -> Self {
        let (mut trials, mut solved_at_reset, mut errors, mut first_error) = (0, 0, 0, None);
        let (mut success_steps, mut best, mut last) = (Vec::new(), Vec::new(), Vec::new());
        for trial in of_row {
            let progress = trial.episode.as_ref().map_or(&[][..], |episode| &episode.progress);
            best.extend(progress.iter().copied().reduce(f64::max));
            last.extend(progress.last().copied());
            match &trial.outcome {
                Outcome::Success => {
                    trials += 1;
                    success_steps.push(trial.episode.as_ref().map_or(0, |episode| episode.steps));
                }
                Outcome::Failure => trials += 1,
                Outcome::SolvedAtReset => solved_at_reset += 1,
                Outcome::Error { message } => {
                    errors += 1;
                    first_error.get_or_insert_with(|| message.clone());
                }
            }
        }
        let successes = success_steps.len();
        let total_steps: u32 = success_steps.iter().sum();
        let training = match model.training_tasks.as_slice() {
            [] => Training::None,
            tasks if tasks.iter().any(|trained| trained == task) => Training::Trained,
            _ => Training::HeldOut,
        };
        Self {
            task: task.to_owned(),
            model: model.name.clone(),
            training,
            successes,
            trials,
            solved_at_reset,
            errors,
            first_error,
            rate: (trials > 0).then(|| successes as f64 / trials as f64),
            interval: (trials > 0).then(|| wilson(successes, trials)),
            mean_success_steps: (successes > 0).then(|| f64::from(total_steps) / successes as f64),
            mean_best_progress: mean(&best),
            mean_final_progress: mean(&last),
        }
    }
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The seeds of trials, by task.
pub(crate) fn seeds<'a>(trials: impl IntoIterator<Item = &'a Trial>) -> BTreeMap<String, BTreeSet<u64>> {
    let mut seeds = BTreeMap::<_, BTreeSet<_>>::new();
    for trial in trials {
        seeds.entry(trial.task.clone()).or_default().insert(trial.seed);
    }
    seeds
}

/// As [`Summary::seeds_digest`].
pub(crate) fn seeds_digest(seeds: &BTreeMap<String, BTreeSet<u64>>) -> String {
    let mut hasher = Sha256::new();
    for (task, seeds) in seeds {
        seeds.iter().for_each(|seed| hasher.update(format!("{task} {seed}\n")));
    }
    hex::encode(hasher.finalize())
}

/// The Wilson score interval of a success rate (Wilson, 1927), at [`CONFIDENCE`]. There must be trials.
fn wilson(successes: usize, trials: usize) -> (f64, f64) {
    let z = normal_quantile();
    let n = trials as f64;
    let rate = successes as f64 / n;
    let centre = rate + z * z / (2.0 * n);
    let spread = z * (rate * (1.0 - rate) / n + z * z / (4.0 * n * n)).sqrt();
    let bound = |value: f64| (value / (1.0 + z * z / n)).clamp(0.0, 1.0);
    (bound(centre - spread), bound(centre + spread))
}

/// The quantile z of the standard normal distribution with [`CONFIDENCE`] between -z and z.
pub(crate) fn normal_quantile() -> f64 {
    Normal::standard().inverse_cdf((1.0 + CONFIDENCE) / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Expected value: `printf 'door-lock 3\nreach 1\nreach 12\n' | sha256sum`.
    #[test]
    fn the_digest_of_the_seeds_does_not_depend_on_their_order() {
        let seeds =
            BTreeMap::from([("reach".into(), BTreeSet::from([12, 1])), ("door-lock".into(), BTreeSet::from([3]))]);
        assert_eq!(seeds_digest(&seeds), "c79db84e7054b56f6f3f0a788a8b6b74435573d8b2c6083fa9f9922afabc92b2");
    }

    /// Expected values: SciPy, `binomtest(successes, trials).proportion_ci(method="wilson")`.
    #[test]
    fn wilson_intervals_are_those_of_scipy() {
        let cases = [
            (10, 20, 0.2993, 0.7007),
            (0, 20, 0.0, 0.1611),
            (20, 20, 0.8389, 1.0),
            (1, 20, 0.0089, 0.2361),
            (0, 1, 0.0, 0.7935),
        ];
        for (successes, trials, low, high) in cases {
            let interval = wilson(successes, trials);
            assert!((interval.0 - low).abs() < 5e-5, "{successes}/{trials}: {interval:?}");
            assert!((interval.1 - high).abs() < 5e-5, "{successes}/{trials}: {interval:?}");
        }
    }
}
