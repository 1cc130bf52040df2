//! The command line.

use clap::{Args, Parser, Subcommand};
use engines::{Device, EngineKind};
use serde::Serialize;
use service_kit::SessionConfig;
use std::path::PathBuf;
use trainer::service;

/// Trainer: records demonstrations, trains the learned methods, publishes checkpoints.
#[derive(Debug, Parser)]
#[command(version)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the service: record demonstration streams, publish checkpoints, run training on request.
    Serve(ServeArgs),
    /// Train a model; the same command resumes an interrupted run.
    Train(TrainArgs),
    /// Print all settings of a preset, as a file for `train --config`.
    Preset(PresetArgs),
    /// Start or resume a training run of the service.
    Start(StartArgs),
    /// Stop a training run of the service, after it has saved its state.
    Stop(StopArgs),
    /// List the training runs of the service.
    Runs(RunsArgs),
    /// Show the progress of a training run of the service until it ends.
    Watch(WatchArgs),
    /// Send recordings to another trainer, as workers do.
    Replay(ReplayArgs),
    /// Copy the recordings of another trainer, then follow it.
    Mirror(MirrorArgs),
    /// Check every recording, and report its contents and faults.
    Verify(VerifyArgs),
    /// List the published versions of models.
    Versions(VersionsArgs),
    /// Make planners serve another version.
    Promote(PromoteArgs),
    /// Make planners serve the version that was promoted before.
    Rollback(RollbackArgs),
}

/// Arguments of `serve`. Each option is also read from the environment (CPN_TRAINER_MAX_RUNS) and from the file.
#[derive(Debug, Args)]
pub struct ServeArgs {
    /// TOML file with these settings.
    #[arg(long = "config", value_name = "FILE")]
    pub file: Option<PathBuf>,
    #[command(flatten)]
    pub config: service::Config,
}

/// Arguments of `train`: overrides of environment, file and preset.
#[derive(Debug, Args, Serialize)]
pub struct TrainArgs {
    /// TOML file with these settings.
    #[arg(long)]
    #[serde(skip)]
    pub config: Option<PathBuf>,
    /// Folder of the recorded demonstrations [default: data/demonstrations].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    dataset: Option<PathBuf>,
    /// Checkpoint to write [default: runs/checkpoints/PRESET.safetensors].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    out: Option<PathBuf>,
    /// Recipe: paper-bc, paper-te-bc, paper-te-bc-horizon, paper-upn, paper-cpn, cpn, cpn-position, jenga or jenga-position [default: cpn].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    preset: Option<String>,
    /// Tasks left out of training, separated by commas.
    #[arg(long, value_delimiter = ',')]
    #[serde(skip_serializing_if = "Option::is_none")]
    hold_out: Option<Vec<String>>,
    /// Seed of initialisation and sampling [default: 0].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    seed: Option<u64>,
    /// Engine that computes: native or torch [default: native on the CPU, torch on a CUDA device].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    engine: Option<EngineKind>,
    /// Device that computes: cpu, cuda or cuda:N [default: cpu].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    device: Option<Device>,
    /// Number of threads [default: 1].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    threads: Option<usize>,
    /// Interval between saved states, in seconds [default: 60].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    save_interval_seconds: Option<f64>,
    /// Folder of progress, TensorBoard events and learning curve [default: runs/training/NAME of the checkpoint].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    run_dir: Option<PathBuf>,
    /// Override of any setting that `cpn-trainer preset` prints, for example training.epochs=8.
    #[arg(long, value_name = "KEY=VALUE")]
    #[serde(skip)]
    pub set: Vec<String>,
    /// Print progress as lines of JSON instead of a bar.
    #[arg(long)]
    #[serde(skip)]
    pub json: bool,
    /// Number of demonstrations to copy from the network's trainer before training begins.
    #[arg(long, value_name = "COUNT")]
    #[serde(skip)]
    pub demonstrations: Option<usize>,
    #[command(flatten)]
    #[serde(skip)]
    pub session: SessionConfig,
}

/// Connection to a trainer.
#[derive(Debug, Args)]
pub struct TrainerArgs {
    /// Name of the trainer.
    #[arg(long, default_value = "trainer")]
    pub trainer: String,
    #[command(flatten)]
    pub session: SessionConfig,
}

/// Arguments of `preset`.
#[derive(Debug, Args)]
pub struct PresetArgs {
    /// One of paper-bc, paper-te-bc, paper-te-bc-horizon, paper-upn, paper-cpn, cpn, cpn-position, jenga, jenga-position.
    #[arg(default_value = "cpn")]
    pub name: String,
}

/// Arguments of `start`.
#[derive(Debug, Args)]
pub struct StartArgs {
    /// Name of the run and of its checkpoint.
    pub name: String,
    /// Recipe: paper-bc, paper-te-bc, paper-te-bc-horizon, paper-upn, paper-cpn, cpn, cpn-position, jenga or jenga-position [default: cpn].
    #[arg(long)]
    pub preset: Option<String>,
    /// Tasks left out of training, separated by commas.
    #[arg(long, value_delimiter = ',')]
    pub hold_out: Vec<String>,
    /// Seed of initialisation and sampling.
    #[arg(long)]
    pub seed: Option<u64>,
    /// Override of any setting that `cpn-trainer preset` prints, for example training.epochs=8.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub settings: Vec<String>,
    #[command(flatten)]
    pub trainer: TrainerArgs,
}

/// Arguments of `stop`.
#[derive(Debug, Args)]
pub struct StopArgs {
    /// Name of the run.
    pub name: String,
    #[command(flatten)]
    pub trainer: TrainerArgs,
}

/// Arguments of `runs`.
#[derive(Debug, Args)]
pub struct RunsArgs {
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub trainer: TrainerArgs,
}

/// Arguments of `watch`.
#[derive(Debug, Args)]
pub struct WatchArgs {
    /// Name of the run.
    pub name: String,
    #[command(flatten)]
    pub trainer: TrainerArgs,
}

/// Arguments of `replay`.
#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// Folder of the recordings.
    #[arg(long, default_value = "data/demonstrations")]
    pub dataset: PathBuf,
    /// Tasks to send; all if none is given.
    #[arg(long, value_delimiter = ',')]
    pub tasks: Vec<String>,
    #[command(flatten)]
    pub session: SessionConfig,
}

/// Arguments of `mirror`.
#[derive(Debug, Args)]
pub struct MirrorArgs {
    /// Folder to record to.
    #[arg(long, default_value = "data/demonstrations")]
    pub dataset: PathBuf,
    /// End once every recording is copied.
    #[arg(long)]
    pub once: bool,
    #[command(flatten)]
    pub session: SessionConfig,
}

/// Arguments of `verify`.
#[derive(Debug, Args)]
pub struct VerifyArgs {
    /// Folder of the recordings.
    #[arg(long, default_value = "data/demonstrations")]
    pub dataset: PathBuf,
    /// Minimum number of tasks.
    #[arg(long, default_value_t = 1)]
    pub tasks: usize,
    /// Minimum number of episodes of each task.
    #[arg(long, default_value_t = 1)]
    pub episodes: usize,
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `versions`.
#[derive(Debug, Args)]
pub struct VersionsArgs {
    /// Name of the model; all models if none is given.
    pub model: Option<String>,
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub session: SessionConfig,
}

/// Arguments of `promote`.
#[derive(Debug, Args)]
pub struct PromoteArgs {
    /// Name of the model.
    pub model: String,
    /// Number of the version.
    pub version: u32,
    #[command(flatten)]
    pub session: SessionConfig,
}

/// Arguments of `rollback`.
#[derive(Debug, Args)]
pub struct RollbackArgs {
    /// Name of the model.
    pub model: String,
    #[command(flatten)]
    pub session: SessionConfig,
}
