//! The command line.

use crate::record::{FIRST_EVALUATION_SEED, GoalSource};
use clap::{Args, Parser, Subcommand, value_parser};
use service_kit::SessionConfig;
use std::path::PathBuf;

/// Measures first-attempt success in closed loop, and reports it.
#[derive(Debug, Parser)]
#[command(name = "cpn-eval", version)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run every model on every variation of every task, then report; trials that the folder already holds are kept.
    Run(Box<RunArgs>),
    /// Report again from the records of a run.
    Report(ReportArgs),
    /// Ask a planner again for every plan of a recorded episode, and compare the answers bit for bit.
    Replay(Box<ReplayArgs>),
}

/// Arguments of `run`.
#[derive(Debug, Clone, Args)]
pub struct RunArgs {
    /// Names of the planners, all with the same checkpoints; trials are spread over those that are alive.
    #[arg(long, value_delimiter = ',', default_value = "planner")]
    pub planner: Vec<String>,
    /// Simulator workers to wait for; all that are alive are used.
    #[arg(long, default_value_t = 1, value_parser = value_parser!(u32).range(1..))]
    pub workers: u32,
    /// Models to compare; every model of the planner if not given.
    #[arg(long, value_delimiter = ',')]
    pub models: Vec<String>,
    /// Tasks to evaluate on.
    #[arg(long, value_delimiter = ',', required = true)]
    pub tasks: Vec<String>,
    /// Variations of each task.
    #[arg(long, default_value_t = 20, value_parser = value_parser!(u32).range(1..=100_000))]
    pub trials: u32,
    /// Seed of the first variation; the others follow it. Seeds below 1000000 belong to demonstrations, and the report
    /// says so.
    #[arg(long, default_value_t = FIRST_EVALUATION_SEED, value_parser = value_parser!(u64).range(..1 << 47))]
    pub first_seed: u64,
    /// Whose end the goal picture shows. Another variation's is an ablation, and the report says so.
    #[arg(long, value_enum, default_value_t = GoalSource::SameVariation)]
    pub goal: GoalSource,
    /// Folder of the records and the report.
    #[arg(long)]
    pub out: PathBuf,
    /// Title of the report.
    #[arg(long, default_value = "First-attempt success rate")]
    pub title: String,
    /// Print the summary as JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Limit of an answer by a planner or worker.
    #[arg(long, default_value_t = 10, value_parser = value_parser!(u64).range(1..=3600))]
    pub timeout_secs: u64,
    /// Time in which a lost router, planner or worker may come back for a trial to go on; after it the trial begins anew.
    #[arg(long, default_value_t = 30, value_parser = value_parser!(u64).range(..=3600))]
    pub recovery_secs: u64,
    /// Limit of the wait for router, planners and workers, and for planners to serve the same models, at the start and whenever no
    /// planner or no worker is left.
    #[arg(long, default_value_t = 60, value_parser = value_parser!(u64).range(1..=86_400))]
    pub wait_secs: u64,
    /// Connection to the planners and the workers.
    #[command(flatten)]
    pub session: SessionConfig,
}

/// Arguments of `report`.
#[derive(Debug, Clone, Args)]
pub struct ReportArgs {
    /// Folder of the records and the report.
    #[arg(long)]
    pub out: PathBuf,
    /// Print the summary as JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `replay`.
#[derive(Debug, Clone, Args)]
pub struct ReplayArgs {
    /// The episode: an MCAP file beside the record of a trial.
    pub file: PathBuf,
    /// Name of the planner to ask.
    #[arg(long, default_value = "planner")]
    pub planner: String,
    /// How to join the planner.
    #[command(flatten)]
    pub session: SessionConfig,
}
