//! The command line.

use crate::compare::Sources;
use crate::planning::Planning;
use crate::record::{FIRST_EVALUATION_SEED, GoalSource};
use clap::{Args, Parser, Subcommand, value_parser};
use service_kit::SessionConfig;
use std::path::PathBuf;

/// Evaluator: first-attempt success rates in closed loop, with confidence intervals.
#[derive(Debug, Parser)]
#[command(name = "cpn-eval", version)]
pub struct Cli {
    /// Subcommand.
    #[command(subcommand)]
    pub command: Command,
}

/// Subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run every model on every variation of every task, then report; the same command resumes an interrupted run.
    Run(Box<RunArgs>),
    /// Report again from the records of an evaluation.
    Report(ReportArgs),
    /// Compare two arms on the same variations: discordant pairs, exact McNemar test, difference of success rates with its interval.
    Compare(CompareArgs),
    /// Replay a recorded episode's plan requests, and compare the plans bit for bit.
    Replay(Box<ReplayArgs>),
}

/// Arguments of `run`.
#[derive(Debug, Clone, Args)]
pub struct RunArgs {
    /// Names of the planners, separated by commas; all serve the same checkpoints and share the trials.
    #[arg(long, value_delimiter = ',', default_value = "planner")]
    pub planner: Vec<String>,
    /// Minimum number of simulator workers; all that are alive are used.
    #[arg(long, default_value_t = 1, value_parser = value_parser!(u32).range(1..))]
    pub workers: u32,
    /// Models to compare, separated by commas. Controls that need no planner: `no-op`, zero action; `oracle`, straight line to the
    /// hand's position in the goal image, gripper zero [default: every model of the planner].
    #[arg(long, value_delimiter = ',')]
    pub models: Vec<String>,
    /// Tasks to evaluate on, separated by commas.
    #[arg(long, value_delimiter = ',', required = true)]
    pub tasks: Vec<String>,
    /// Number of trials of each task, each of another variation.
    #[arg(long, default_value_t = 20, value_parser = value_parser!(u32).range(1..=100_000))]
    pub trials: u32,
    /// Seed of the first variation; the others follow it. Seeds below 1000000 belong to demonstrations, which the report mentions.
    #[arg(long, default_value_t = FIRST_EVALUATION_SEED, value_parser = value_parser!(u64).range(..1 << 47))]
    pub first_seed: u64,
    /// Variation whose end the goal image shows. Another one than the trial's is an ablation, which the report mentions.
    #[arg(long, value_enum, default_value_t = GoalSource::SameVariation)]
    pub goal: GoalSource,
    /// Plans in closed loop.
    #[command(flatten)]
    pub planning: Planning,
    /// Folder of records and report.
    #[arg(long)]
    pub out: PathBuf,
    /// Title of the report.
    #[arg(long, default_value = "First-attempt success rate")]
    pub title: String,
    /// Print the summary as JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Timeout of a request to a planner or worker, in seconds.
    #[arg(long, default_value_t = 10, value_parser = value_parser!(u64).range(1..=3600))]
    pub timeout_secs: u64,
    /// Time for a lost router, planner or worker to come back, in seconds; after it the trial restarts from its seed.
    #[arg(long, default_value_t = 30, value_parser = value_parser!(u64).range(..=3600))]
    pub recovery_secs: u64,
    /// Timeout of the wait for router, planners, workers and models, in seconds: at the start, and whenever none is left.
    #[arg(long, default_value_t = 60, value_parser = value_parser!(u64).range(1..=86_400))]
    pub wait_secs: u64,
    /// Connection to the planners and the workers.
    #[command(flatten)]
    pub session: SessionConfig,
}

/// Arguments of `report`.
#[derive(Debug, Clone, Args)]
pub struct ReportArgs {
    /// Folder of records and report.
    #[arg(long)]
    pub out: PathBuf,
    /// Print the summary as JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `compare`.
#[derive(Debug, Clone, Args)]
pub struct CompareArgs {
    /// First arm: FOLDER of an evaluation, or FOLDER:MODEL. Several, separated by commas, are training runs, or other tasks.
    pub a: Sources,
    /// Second arm, likewise; differences are A - B.
    pub b: Sources,
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `replay`.
#[derive(Debug, Clone, Args)]
pub struct ReplayArgs {
    /// Recorded episode: an MCAP file beside the record of a trial.
    pub file: PathBuf,
    /// Name of the planner.
    #[arg(long, default_value = "planner")]
    pub planner: String,
    /// Connection to the planner.
    #[command(flatten)]
    pub session: SessionConfig,
}
