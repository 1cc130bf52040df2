//! Success rates and their confidence intervals.

use crate::record::{Model, Outcome, Run, Trial};
use serde::Serialize;
use statrs::distribution::{ContinuousCDF, Normal};

/// Confidence of the intervals.
pub(crate) const CONFIDENCE: f64 = 0.95;

/// What a run has shown.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// What was compared, and how.
    pub run: Run,
    /// How the intervals were computed.
    pub interval_method: &'static str,
    /// Their confidence.
    pub confidence: f64,
    /// Whether models may have been trained on the very variations: the seeds are those of demonstrations.
    pub demonstration_seeds: bool,
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
    /// Trials that were not brought to an end.
    pub errors: usize,
    /// What went wrong first, if anything did.
    pub first_error: Option<String>,
    /// Share of the trials that succeeded.
    pub rate: Option<f64>,
    /// Wilson score interval of the rate.
    pub interval: Option<(f64, f64)>,
    /// Mean number of steps of the successes.
    pub mean_success_steps: Option<f64>,
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
    /// What tables say.
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
        Self { run, demonstration_seeds, interval_method: "Wilson score", confidence: CONFIDENCE, rows }
    }

    /// Trials that were not brought to an end.
    pub fn errors(&self) -> usize {
        self.rows.iter().map(|row| row.errors).sum()
    }
}

impl Row {
    fn new<'a>(task: &str, model: &Model, of_row: impl Iterator<Item = &'a Trial>) -> Self {
        let (mut trials, mut errors, mut first_error, mut success_steps) = (0, 0, None, Vec::new());
        for trial in of_row {
            match &trial.outcome {
                Outcome::Success => {
                    trials += 1;
                    success_steps.push(trial.episode.as_ref().map_or(0, |episode| episode.steps));
                }
                Outcome::Failure => trials += 1,
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
            errors,
            first_error,
            rate: (trials > 0).then(|| successes as f64 / trials as f64),
            interval: (trials > 0).then(|| wilson(successes, trials)),
            mean_success_steps: (successes > 0).then(|| f64::from(total_steps) / successes as f64),
        }
    }
}

/// The Wilson score interval of a success rate (Wilson, 1927), at [`CONFIDENCE`]. There must be trials.
fn wilson(successes: usize, trials: usize) -> (f64, f64) {
    let z = Normal::standard().inverse_cdf((1.0 + CONFIDENCE) / 2.0);
    let n = trials as f64;
    let rate = successes as f64 / n;
    let centre = rate + z * z / (2.0 * n);
    let spread = z * (rate * (1.0 - rate) / n + z * z / (4.0 * n * n)).sqrt();
    let bound = |value: f64| (value / (1.0 + z * z / n)).clamp(0.0, 1.0);
    (bound(centre - spread), bound(centre + spread))
}

#[cfg(test)]
mod tests {
    use super::*;

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
