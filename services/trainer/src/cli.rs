//! The command line.

use clap::{Args, Parser, Subcommand};
use serde::Serialize;
use service_kit::SessionConfig;
use std::path::PathBuf;

/// Take in demonstrations, train the learned methods, publish checkpoints.
#[derive(Debug, Parser)]
#[command(version)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Keep the episodes of demonstration streams and publish the checkpoints of a folder.
    Serve(ServeArgs),
    /// Train a method; the same command goes on where an interrupted one stopped.
    Train(TrainArgs),
    /// Send recordings to a recorder, as the workers did.
    Replay(ReplayArgs),
    /// Fetch what another recorder keeps, then follow it.
    Mirror(MirrorArgs),
    /// Read every recording and report what is in them and what is wrong.
    Verify(VerifyArgs),
}

/// What was typed; what was not is left to the environment, the file and the defaults.
#[derive(Debug, Args, Serialize)]
pub struct ServeArgs {
    /// TOML file with these settings.
    #[arg(long)]
    #[serde(skip)]
    pub config: Option<PathBuf>,
    /// Where episodes are kept.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    dataset: Option<PathBuf>,
    /// Whose checkpoints are published.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    checkpoints: Option<PathBuf>,
    #[command(flatten)]
    session: SessionConfig,
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
    /// Method to train: bc, te-bc, upn or cpn.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    method: Option<String>,
    /// What observations and goals are: image or position.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    input: Option<String>,
    /// Planned steps.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    horizon: Option<i64>,
    /// Gradient updates of a plan.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    updates: Option<i64>,
    /// Share of the goals that are told in hindsight, of positions.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    hindsight: Option<f64>,
    /// Encoder of images to train it with: paper or upn.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    encoder: Option<String>,
    /// Tasks that the model must not see.
    #[arg(long, value_delimiter = ',')]
    #[serde(skip_serializing_if = "Option::is_none")]
    hold_out: Option<Vec<String>>,
    /// Passes over every frame.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    epochs: Option<u32>,
    /// Samples of a step.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    batch_size: Option<usize>,
    /// Seed of initialisation and sampling.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    seed: Option<u64>,
    /// Threads of libtorch.
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    threads: Option<i32>,
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
