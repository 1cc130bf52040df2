//! `cpn-trainer`: the service that takes in demonstrations and publishes checkpoints, and the training run.

use clap::{Args, Parser, Subcommand};
use serde::Serialize;
use service_kit::{SessionConfig, config, shutdown, telemetry};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use trainer::service;
use trainer::train::{self, Outcome};

/// Take in demonstrations, train the learned methods, publish checkpoints.
#[derive(Debug, Parser)]
#[command(version)]
struct Cli {
    /// TOML file with the settings of the command.
    #[arg(long, global = true)]
    config: Option<PathBuf>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Keep the episodes of demonstration streams and publish the checkpoints of a folder.
    Serve(ServeArgs),
    /// Train a method; the same command goes on where an interrupted one stopped.
    Train(TrainArgs),
}

/// What was typed; what was not is left to the environment, the file and the defaults.
#[derive(Debug, Args, Serialize)]
struct ServeArgs {
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
struct TrainArgs {
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
    /// Encoder to train it with: paper or upn.
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

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let cli = Cli::parse();
    telemetry::init();
    match cli.command {
        Command::Serve(arguments) => serve(config::load("CPN_TRAINER_", cli.config.as_deref(), &arguments)?).await,
        Command::Train(arguments) => train(config::load("CPN_TRAIN_", cli.config.as_deref(), &arguments)?).await,
    }
}

async fn serve(config: service::Config) -> anyhow::Result<()> {
    let mut service = service::start(config).await?;
    tokio::select! {
        failed = service.failed() => failed?,
        signal = shutdown::requested() => signal?,
    }
    service.shutdown().await
}

async fn train(config: train::Config) -> anyhow::Result<()> {
    let stop = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&stop);
    let mut run = tokio::task::spawn_blocking(move || train::run(&config, &|_| seen.load(Ordering::Relaxed)));
    let outcome = tokio::select! {
        outcome = &mut run => outcome??,
        signal = shutdown::requested() => {
            signal?;
            stop.store(true, Ordering::Relaxed);
            run.await??
        }
    };
    match outcome {
        Outcome::Finished { digest } => tracing::info!(digest, "checkpoint written"),
        Outcome::Interrupted { step } => tracing::info!(step, "interrupted; the same command goes on from here"),
    }
    Ok(())
}
