//! The command line.

use clap::{Args, Parser, Subcommand};
use serde::Serialize;
use service_kit::SessionConfig;
use std::path::PathBuf;
use trainer::service;

/// Take in demonstrations, train the learned methods, publish checkpoints.
#[derive(Debug, Parser)]
#[command(version)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Keep the episodes of demonstration streams, publish the checkpoints of a folder, and run training when asked to.
    Serve(ServeArgs),
    /// Train a model; the same command goes on where an interrupted one stopped.
    Train(TrainArgs),
    /// Print all settings of a preset, as a file that `train --config` takes.
    Preset(PresetArgs),
    /// Start a training run of a trainer that serves, or take up one.
    Start(StartArgs),
    /// Let a training run save its state and end.
    Stop(StopArgs),
    /// List the training runs.
    Runs(RunsArgs),
    /// Show the progress of a training run until it ends.
    Watch(WatchArgs),
    /// Send recordings to a recorder, as the workers did.
    Replay(ReplayArgs),
    /// Fetch what another recorder keeps, then follow it.
    Mirror(MirrorArgs),
    /// Read every recording and report what is in them and what is wrong.
    Verify(VerifyArgs),
    /// List the published versions that a trainer keeps.
    Versions(VersionsArgs),
    /// Let planners serve a version that is kept.
    Promote(PromoteArgs),
    /// Let planners serve the version that was promoted before.
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

/// What was typed; what was not is left to the environment, the file and the defaults.
#[derive(Debug, Args, Serialize)]
pub struct TrainArgs {
    /// TOML file with these settings.
    #[arg(long)]
    #[serde(skip)]
    pub config: Option<PathBuf>,
    /// Folder of the demonstrations.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    dataset: Option<PathBuf>,
    /// Where the checkpoint goes.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    out: Option<PathBuf>,
    /// What to train: paper-bc, paper-te-bc, paper-upn, paper-cpn, cpn or jenga [default: cpn].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    preset: Option<String>,
    /// Tasks that the model must not see.
    #[arg(long, value_delimiter = ',')]
    #[serde(skip_serializing_if = "Option::is_none")]
    hold_out: Option<Vec<String>>,
    /// Seed of initialisation and sampling.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    seed: Option<u64>,
    /// Threads that compute [default: 1].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    threads: Option<usize>,
    /// How often the run saves its state [default: 60].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    save_interval_seconds: Option<f64>,
    /// Where the run keeps its progress, events and curve [default: runs/training/ and the name of the checkpoint].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    run_dir: Option<PathBuf>,
    /// Change any setting that `cpn-trainer preset` shows, for example training.epochs=8.
    #[arg(long, value_name = "KEY=VALUE")]
    #[serde(skip)]
    pub set: Vec<String>,
    /// Print progress as lines of JSON instead of a bar.
    #[arg(long)]
    #[serde(skip)]
    pub json: bool,
    /// First follow the network's demonstrations until so many are kept.
    #[arg(long, value_name = "COUNT")]
    #[serde(skip)]
    pub demonstrations: Option<usize>,
    #[command(flatten)]
    #[serde(skip)]
    pub session: SessionConfig,
}

/// Which trainer is asked.
#[derive(Debug, Args)]
pub struct TrainerArgs {
    /// Name of the trainer.
    #[arg(long, default_value = "trainer")]
    pub trainer: String,
    #[command(flatten)]
    pub session: SessionConfig,
}

/// What was typed.
#[derive(Debug, Args)]
pub struct PresetArgs {
    /// One of paper-bc, paper-te-bc, paper-upn, paper-cpn, cpn, jenga.
    #[arg(default_value = "cpn")]
    pub name: String,
}

/// What was typed.
#[derive(Debug, Args)]
pub struct StartArgs {
    /// Name of the run and of its checkpoint.
    pub name: String,
    /// Where the settings start from.
    #[arg(long)]
    pub preset: Option<String>,
    /// Tasks that the model must not see.
    #[arg(long, value_delimiter = ',')]
    pub hold_out: Vec<String>,
    /// Seed of initialisation and sampling.
    #[arg(long)]
    pub seed: Option<u64>,
    /// A further setting of `train`, in TOML: --set epochs=50, for example.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub settings: Vec<String>,
    #[command(flatten)]
    pub trainer: TrainerArgs,
}

/// What was typed.
#[derive(Debug, Args)]
pub struct StopArgs {
    /// Name of the run.
    pub name: String,
    #[command(flatten)]
    pub trainer: TrainerArgs,
}

/// What was typed.
#[derive(Debug, Args)]
pub struct RunsArgs {
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub trainer: TrainerArgs,
}

/// What was typed.
#[derive(Debug, Args)]
pub struct WatchArgs {
    /// Name of the run.
    pub name: String,
    #[command(flatten)]
    pub trainer: TrainerArgs,
}

/// What was typed.
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

/// What was typed.
#[derive(Debug, Args)]
pub struct MirrorArgs {
    /// Where the recordings go.
    #[arg(long, default_value = "data/demonstrations")]
    pub dataset: PathBuf,
    /// Stop as soon as nothing is lacking.
    #[arg(long)]
    pub once: bool,
    #[command(flatten)]
    pub session: SessionConfig,
}

/// What was typed.
#[derive(Debug, Args)]
pub struct VerifyArgs {
    /// Folder of the recordings.
    #[arg(long, default_value = "data/demonstrations")]
    pub dataset: PathBuf,
    /// Tasks that there must be at least.
    #[arg(long, default_value_t = 1)]
    pub tasks: usize,
    /// Episodes that each task must have at least.
    #[arg(long, default_value_t = 1)]
    pub episodes: usize,
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// What was typed.
#[derive(Debug, Args)]
pub struct VersionsArgs {
    /// The model whose versions to list; all if none is given.
    pub model: Option<String>,
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub session: SessionConfig,
}

/// What was typed.
#[derive(Debug, Args)]
pub struct PromoteArgs {
    /// Name of the model.
    pub model: String,
    /// The version to serve.
    pub version: u32,
    #[command(flatten)]
    pub session: SessionConfig,
}

/// What was typed.
#[derive(Debug, Args)]
pub struct RollbackArgs {
    /// Name of the model.
    pub model: String,
    #[command(flatten)]
    pub session: SessionConfig,
}
