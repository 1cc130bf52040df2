//! Progress of an evaluation: a bar in a terminal, a line at intervals elsewhere.

use indicatif::{ProgressBar, ProgressStyle};

/// The progress of an evaluation.
#[derive(Debug)]
pub(crate) struct Progress {
    bar: ProgressBar,
    total: usize,
    models: Vec<Count>,
}

/// Trials and successes of a model in this invocation.
#[derive(Debug)]
struct Count {
    model: String,
    successes: usize,
    trials: usize,
}

impl Progress {
    pub(crate) fn new(total: usize, left: usize, models: impl Iterator<Item = String>) -> Self {
        let bar = ProgressBar::new(total as u64).with_position((total - left) as u64);
        if let Ok(style) = ProgressStyle::with_template("{bar:30} {pos}/{len} trials, {eta} left  {msg}") {
            bar.set_style(style);
        }
        bar.reset_eta();
        if left < total {
            tracing::info!("{} of {total} trials are there already", total - left);
        }
        Self { bar, total, models: models.map(|model| Count { model, successes: 0, trials: 0 }).collect() }
    }

    /// Counts a trial that came to its end.
    pub(crate) fn count(&mut self, model: usize, success: bool) {
        let count = &mut self.models[model];
        count.trials += 1;
        count.successes += usize::from(success);
        self.bar.set_message(self.successes());
    }

    /// Shows how many trials are left.
    pub(crate) fn left(&self, left: usize) {
        let position = self.total.saturating_sub(left);
        self.bar.set_position(position as u64);
        let now_and_then = left == 0 || position.is_multiple_of((self.total / 20).max(1));
        if self.bar.is_hidden() && now_and_then {
            tracing::info!("{position} of {} trials; successes: {}", self.total, self.successes());
        }
    }

    /// Logs something above the bar.
    pub(crate) fn say(&self, log: impl FnOnce()) {
        self.bar.suspend(log);
    }

    fn successes(&self) -> String {
        let count = |count: &Count| format!("{} {}/{}", count.model, count.successes, count.trials);
        self.models.iter().map(count).collect::<Vec<_>>().join("  ")
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
