//! Training runs: starting, stopping and watching them.

use crate::message::{digest, name, required};
use crate::{Error, Message, proto};
use serde::{Deserialize, Serialize};

/// Largest number of held-out tasks.
const MAX_TASKS: usize = 1000;
/// Longest settings, in bytes.
const MAX_SETTINGS_BYTES: usize = 16 << 10;
/// Longest reason of a failure, in bytes.
pub const MAX_REASON_BYTES: usize = 2000;
/// Largest number of runs in a list.
pub const MAX_RUNS: usize = 1000;

/// Progress of a run after a step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Steps done.
    pub step: u64,
    /// Steps of the whole run, at least 1.
    pub steps: u64,
    /// Epochs completed: passes over all samples.
    pub epoch: u64,
    /// Epochs of the whole run.
    pub epochs: u64,
    /// Samples trained on, counted once per epoch.
    pub samples: u64,
    /// Running mean of the outer loss.
    pub loss: f64,
    /// Learning rate of the step.
    pub learning_rate: f64,
    /// Norm of the gradient over all weights, before clipping.
    pub gradient_norm: f64,
    /// Throughput since the start of the run's process, in samples per second.
    pub samples_per_second: f64,
}

/// State of a training run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "state")]
pub enum RunState {
    /// Training.
    Running,
    /// Finished; the checkpoint is written.
    Finished {
        /// SHA-256 of the checkpoint, in hex.
        digest: String,
    },
    /// Stopped by request; can be resumed.
    Stopped,
    /// Failed; can be resumed.
    Failed {
        /// Exit status and end of the log.
        reason: String,
    },
    /// Ended with the service that had started it; can be resumed.
    Interrupted,
}

impl RunState {
    /// Name of the state.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Running => "running",
            Self::Finished { .. } => "finished",
            Self::Stopped => "stopped",
            Self::Failed { .. } => "failed",
            Self::Interrupted => "interrupted",
        }
    }
}

/// Training run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Name of the run.
    pub name: String,
    /// State of the run.
    #[serde(flatten)]
    pub state: RunState,
    /// Progress; none before the first step.
    pub progress: Option<Progress>,
}

/// Request to start a run, or to resume one that stopped, failed or was interrupted.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct StartRunRequest {
    /// Name of the run, its folder and its checkpoint.
    pub name: String,
    /// Preset that the settings start from.
    pub preset: Option<String>,
    /// Held-out tasks, whose demonstrations are not trained on.
    pub hold_out: Vec<String>,
    /// Seed of initialisation and sampling.
    pub seed: Option<u64>,
    /// Further settings, in TOML.
    pub settings: String,
}

/// Started run.
#[derive(Debug, Clone, PartialEq)]
pub struct StartRunResponse {
    /// The run as of now.
    pub run: Run,
}

/// Request to stop a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StopRunRequest {
    /// Name of the run.
    pub name: String,
}

/// Stopped run.
#[derive(Debug, Clone, PartialEq)]
pub struct StopRunResponse {
    /// The run as of now.
    pub run: Run,
}

/// Request for all runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ListRunsRequest;

/// All runs.
#[derive(Debug, Clone, PartialEq)]
pub struct ListRunsResponse {
    /// Runs, ordered by name.
    pub runs: Vec<Run>,
}

/// Request for a run's state now and at each change.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WatchRunRequest {
    /// Name of the run.
    pub name: String,
}

/// State of a watched run.
#[derive(Debug, Clone, PartialEq)]
pub struct WatchRunResponse {
    /// The run as of now.
    pub run: Run,
}

impl TryFrom<proto::TrainingProgress> for Progress {
    type Error = Error;

    fn try_from(progress: proto::TrainingProgress) -> Result<Self, Error> {
        let proto::TrainingProgress { step, steps, epoch, epochs, samples, .. } = progress;
        if steps == 0 {
            return Err(Error::invalid("steps", "at least 1", 0));
        }
        let finite = |field, value: f64| match value.is_finite() {
            true => Ok(value),
            false => Err(Error::invalid(field, "a finite number", value)),
        };
        Ok(Self {
            step,
            steps,
            epoch,
            epochs,
            samples,
            loss: finite("loss", progress.loss)?,
            learning_rate: finite("learning_rate", progress.learning_rate)?,
            gradient_norm: finite("gradient_norm", progress.gradient_norm)?,
            samples_per_second: finite("samples_per_second", progress.samples_per_second)?,
        })
    }
}

impl From<Progress> for proto::TrainingProgress {
    fn from(progress: Progress) -> Self {
        let Progress { step, steps, epoch, epochs, samples, .. } = progress;
        let Progress { loss, learning_rate, gradient_norm, samples_per_second, .. } = progress;
        Self { step, steps, epoch, epochs, samples, loss, learning_rate, gradient_norm, samples_per_second }
    }
}

impl Message for Run {
    type Proto = proto::Run;
}

impl TryFrom<proto::Run> for Run {
    type Error = Error;

    fn try_from(run: proto::Run) -> Result<Self, Error> {
        let state = match run.state() {
            proto::RunState::Unspecified => {
                return Err(Error::invalid("state", "a state", proto::RunState::Unspecified.as_str_name()));
            }
            proto::RunState::Running => RunState::Running,
            proto::RunState::Finished => RunState::Finished { digest: digest("digest", run.digest)? },
            proto::RunState::Stopped => RunState::Stopped,
            proto::RunState::Failed => RunState::Failed { reason: bounded("reason", run.reason, MAX_REASON_BYTES)? },
            proto::RunState::Interrupted => RunState::Interrupted,
        };
        let progress = run.progress.map(|progress| required("progress", Some(progress))).transpose()?;
        Ok(Self { name: name("name", run.name)?, state, progress })
    }
}

impl From<Run> for proto::Run {
    fn from(Run { name, state, progress }: Run) -> Self {
        let (state, digest, reason) = match state {
            RunState::Running => (proto::RunState::Running, String::new(), String::new()),
            RunState::Finished { digest } => (proto::RunState::Finished, digest, String::new()),
            RunState::Stopped => (proto::RunState::Stopped, String::new(), String::new()),
            RunState::Failed { reason } => (proto::RunState::Failed, String::new(), reason),
            RunState::Interrupted => (proto::RunState::Interrupted, String::new(), String::new()),
        };
        Self { name, state: state.into(), progress: progress.map(Into::into), digest, reason }
    }
}

impl Message for StartRunRequest {
    type Proto = proto::StartRunRequest;
}

impl TryFrom<proto::StartRunRequest> for StartRunRequest {
    type Error = Error;

    fn try_from(request: proto::StartRunRequest) -> Result<Self, Error> {
        let proto::StartRunRequest { preset, hold_out, seed, settings, .. } = request;
        if hold_out.len() > MAX_TASKS {
            return Err(Error::invalid("hold_out", format!("at most {MAX_TASKS} tasks"), hold_out.len()));
        }
        Ok(Self {
            name: name("name", request.name)?,
            preset: (!preset.is_empty()).then(|| name("preset", preset)).transpose()?,
            hold_out: hold_out.into_iter().map(|task| name("hold_out", task)).collect::<Result<_, _>>()?,
            seed,
            settings: bounded("settings", settings, MAX_SETTINGS_BYTES)?,
        })
    }
}

impl From<StartRunRequest> for proto::StartRunRequest {
    fn from(request: StartRunRequest) -> Self {
        let StartRunRequest { name, preset, hold_out, seed, settings } = request;
        Self { name, preset: preset.unwrap_or_default(), hold_out, seed, settings }
    }
}

impl Message for ListRunsRequest {
    type Proto = proto::ListRunsRequest;
}

impl TryFrom<proto::ListRunsRequest> for ListRunsRequest {
    type Error = Error;

    fn try_from(_: proto::ListRunsRequest) -> Result<Self, Error> {
        Ok(Self)
    }
}

impl From<ListRunsRequest> for proto::ListRunsRequest {
    fn from(_: ListRunsRequest) -> Self {
        Self {}
    }
}

impl Message for ListRunsResponse {
    type Proto = proto::ListRunsResponse;
    const MAX_BYTES: usize = 4 << 20;
}

impl TryFrom<proto::ListRunsResponse> for ListRunsResponse {
    type Error = Error;

    fn try_from(response: proto::ListRunsResponse) -> Result<Self, Error> {
        if response.runs.len() > MAX_RUNS {
            return Err(Error::invalid("runs", format!("at most {MAX_RUNS}"), response.runs.len()));
        }
        let runs = response.runs.into_iter().map(|run| Run::try_from(run).map_err(|e| e.within("runs")));
        Ok(Self { runs: runs.collect::<Result<_, _>>()? })
    }
}

impl From<ListRunsResponse> for proto::ListRunsResponse {
    fn from(response: ListRunsResponse) -> Self {
        Self { runs: response.runs.into_iter().map(Into::into).collect() }
    }
}

/// Implements the conversions of messages with a single field: a run, or its name.
macro_rules! of_one_run {
    ($field:ident, $read:expr, $write:expr; $($message:ident),+) => {$(
        impl Message for $message {
            type Proto = proto::$message;
        }

        impl TryFrom<proto::$message> for $message {
            type Error = Error;

            fn try_from(message: proto::$message) -> Result<Self, Error> {
                Ok(Self { $field: $read(stringify!($field), message.$field)? })
            }
        }

        impl From<$message> for proto::$message {
            fn from(message: $message) -> Self {
                Self { $field: $write(message.$field) }
            }
        }
    )+};
}

of_one_run!(name, name, std::convert::identity; StopRunRequest, WatchRunRequest);
of_one_run!(run, run, |run: Run| Some(run.into()); StartRunResponse, StopRunResponse, WatchRunResponse);

fn run(field: &str, run: Option<proto::Run>) -> Result<Run, Error> {
    required(field, run)
}

fn bounded(field: &str, text: String, limit: usize) -> Result<String, Error> {
    match text.len() {
        length if length > limit => {
            Err(Error::invalid(field, format!("at most {limit} bytes"), format!("{length} bytes")))
        }
        _ => Ok(text),
    }
}
