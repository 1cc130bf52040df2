//! Progress of a training run, and its observers.

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use std::io::Write;
use std::time::{Duration, Instant};
use tracing::info;
pub use wire::training::Progress;

/// Weight of a step in the running mean of the loss.
const LOSS_WEIGHT: f64 = 0.02;
/// Minimum time between two lines of JSON.
const LINE_INTERVAL: Duration = Duration::from_millis(100);

/// Observer of a run, which may interrupt it.
pub trait Observer {
    /// Called at the start of a run, or at its resumption after `step` steps.
    ///
    /// # Errors
    /// If notes of previous steps cannot be continued.
    fn begin(&mut self, _step: u64) -> anyhow::Result<()> {
        Ok(())
    }

    /// True if the run shall save its state and end; called before each step with the number of completed steps.
    fn should_stop(&self, _step: u64) -> bool {
        false
    }

    /// Called after each step.
    ///
    /// # Errors
    /// If the progress cannot be noted.
    fn observe(&mut self, _progress: &Progress) -> anyhow::Result<()> {
        Ok(())
    }
}

/// Several observers as one: all are called, and any may interrupt the run.
impl Observer for Vec<Box<dyn Observer>> {
    fn begin(&mut self, step: u64) -> anyhow::Result<()> {
        self.iter_mut().try_for_each(|observer| observer.begin(step))
    }

    fn should_stop(&self, step: u64) -> bool {
        self.iter().any(|observer| observer.should_stop(step))
    }

    fn observe(&mut self, progress: &Progress) -> anyhow::Result<()> {
        self.iter_mut().try_for_each(|observer| observer.observe(progress))
    }
}

/// Observer that interrupts a run when the function, of the number of completed steps, returns true.
#[derive(Debug)]
pub struct StopIf<F>(pub F);

impl<F: Fn(u64) -> bool> Observer for StopIf<F> {
    fn should_stop(&self, step: u64) -> bool {
        self.0(step)
    }
}

/// Progress bar on a terminal, and a line in the log for each epoch.
#[derive(Debug)]
pub struct Bar(ProgressBar);

impl Bar {
    /// A bar of a run, by its name.
    pub fn new(name: &str) -> Self {
        let style = "{prefix:>5} {wide_bar} {pos}/{len} steps, {msg}, {eta} left";
        let style = ProgressStyle::with_template(style).expect("a valid template");
        Self(ProgressBar::no_length().with_style(style).with_prefix(name.to_owned()))
    }
}

impl Observer for Bar {
    fn begin(&mut self, step: u64) -> anyhow::Result<()> {
        self.0.set_position(step);
        self.0.reset_eta();
        Ok(())
    }

    fn observe(&mut self, progress: &Progress) -> anyhow::Result<()> {
        let Progress { step, steps, epoch, loss, samples_per_second, .. } = *progress;
        self.0.set_length(steps);
        self.0.set_position(step);
        self.0.set_message(format!("loss {loss:.4}, {samples_per_second:.0} samples/s"));
        if ends_epoch(progress) {
            let (loss, rate) = (format!("{loss:.4}"), format!("{samples_per_second:.0}"));
            self.0.suspend(|| info!(epoch, loss, samples_per_second = rate, "epoch done"));
        }
        Ok(())
    }
}

/// Progress as lines of JSON on standard output, at most ten a second. If they cannot be written, the run is interrupted.
#[derive(Debug, Default)]
pub struct JsonLines {
    printed: Option<Instant>,
    unread: bool,
}

impl Observer for JsonLines {
    fn should_stop(&self, _step: u64) -> bool {
        self.unread
    }

    fn observe(&mut self, progress: &Progress) -> anyhow::Result<()> {
        let due = self.printed.is_none_or(|printed| printed.elapsed() > LINE_INTERVAL);
        if due || progress.step == progress.steps {
            self.unread = print_line(progress).is_err();
            self.printed = Some(Instant::now());
        }
        Ok(())
    }
}

/// Prints a value as one line of JSON.
///
/// # Errors
/// If standard output cannot be written.
pub fn print_line(value: &impl Serialize) -> std::io::Result<()> {
    let mut line = serde_json::to_vec(value)?;
    line.push(b'\n');
    let mut out = std::io::stdout().lock();
    out.write_all(&line)?;
    out.flush()
}

/// True after the last step of an epoch.
pub(crate) fn ends_epoch(progress: &Progress) -> bool {
    (progress.step * progress.epochs).is_multiple_of(progress.steps)
}

/// Computes the progress of a run from its steps.
#[derive(Debug)]
pub(crate) struct Meter {
    /// Number of steps of the whole run.
    steps: u64,
    /// Number of epochs of the whole run.
    epochs: u64,
    /// Number of samples so far.
    samples: u64,
    /// Running mean of the outer loss; `None` before the first step.
    pub(crate) loss: Option<f64>,
    /// Start of this process, and the number of samples at that time.
    began: (Instant, u64),
}

impl Meter {
    pub(crate) fn new(steps: u64, epochs: u64, samples: u64, loss: Option<f64>) -> Self {
        Self { steps, epochs, samples, loss, began: (Instant::now(), samples) }
    }

    /// Progress after a step on `samples` samples; `step` is the number of completed steps.
    pub(crate) fn step(&mut self, step: u64, samples: usize, loss: f64, learning_rate: f64, norm: f64) -> Progress {
        let Self { steps, epochs, began: (instant, before), .. } = *self;
        self.samples += samples as u64;
        let loss = self.loss.map_or(loss, |mean| mean + LOSS_WEIGHT * (loss - mean));
        self.loss = Some(loss);
        Progress {
            step,
            steps,
            epoch: step * epochs / steps,
            epochs,
            samples: self.samples,
            loss,
            learning_rate,
            gradient_norm: norm,
            samples_per_second: (self.samples - before) as f64 / instant.elapsed().as_secs_f64(),
        }
    }
}
