//! `cpn-trainer`: the service that takes in demonstrations and publishes checkpoints, the training run, and what else is
//! done with recordings.

mod cli;

use anyhow::{anyhow, ensure};
use clap::Parser;
use cli::{
    Cli, Command, MirrorArgs, PresetArgs, PromoteArgs, ReplayArgs, RollbackArgs, VerifyArgs, VersionsArgs,
};
use cpn::Preset;
use serde::Deserialize;
use serde::de::{IntoDeserializer, value};
use service_kit::{config, session, shutdown, telemetry};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use trainer::config::Config;
use trainer::progress::{Bar, Observer, StopIf};
use trainer::recordings::Recordings;
use trainer::train::{self, Outcome};
use trainer::{mirror, publish, replay, service, verify};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let cli = Cli::parse();
    telemetry::init();
    match cli.command {
        Command::Serve(arguments) => {
            serve(config::load("CPN_TRAINER_", arguments.config.as_deref(), &arguments)?).await
        }
        Command::Train(arguments) => {
            train(Config::load(arguments.config.as_deref(), &arguments, &arguments.set)?).await
        }
        Command::Preset(arguments) => print_preset(&arguments),
        Command::Replay(arguments) => replay(arguments).await,
        Command::Mirror(arguments) => mirror(arguments).await,
        Command::Verify(arguments) => verify(&arguments),
        Command::Versions(arguments) => versions(arguments).await,
        Command::Promote(arguments) => promote(arguments).await,
        Command::Rollback(arguments) => rollback(arguments).await,
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

async fn train(config: Config) -> anyhow::Result<()> {
    let stop = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&stop);
    let mut run = tokio::task::spawn_blocking(move || {
        let stopped = StopIf(move |_| seen.load(Ordering::Relaxed));
        let mut observers: Vec<Box<dyn Observer>> = vec![Box::new(stopped), Box::new(Bar::new(config.preset.name()))];
        train::run(&config, &mut observers)
    });
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

fn print_preset(PresetArgs { name }: &PresetArgs) -> anyhow::Result<()> {
    let preset = Preset::deserialize(name.as_str().into_deserializer()).map_err(|e: value::Error| anyhow!(e))?;
    print!("{}", toml::to_string(&Config::from(preset))?);
    Ok(())
}

async fn replay(ReplayArgs { dataset, tasks, session }: ReplayArgs) -> anyhow::Result<()> {
    let session = session::open(&session).await?;
    replay::run(&session, &dataset, &tasks).await?;
    session.close().await.map_err(|e| anyhow!(e))
}

async fn mirror(MirrorArgs { dataset, once, session }: MirrorArgs) -> anyhow::Result<()> {
    let recordings = Arc::new(Recordings::open(dataset)?);
    let session = session::open(&session).await?;
    let work = async {
        if once { Ok(mirror::once(&session, &recordings).await?) } else { mirror::follow(&session, &recordings).await }
    };
    tokio::select! {
        done = work => done.map_err(|e| anyhow!(e))?,
        signal = shutdown::requested() => signal?,
    }
    session.close().await.map_err(|e| anyhow!(e))
}

fn verify(VerifyArgs { dataset, tasks, episodes, json }: &VerifyArgs) -> anyhow::Result<()> {
    let report = verify::run(dataset, *tasks, *episodes)?;
    if *json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print!("{report}");
    }
    ensure!(report.faults.is_empty(), "{}: {} faults", dataset.display(), report.faults.len());
    Ok(())
}

async fn versions(VersionsArgs { model, json, session }: VersionsArgs) -> anyhow::Result<()> {
    let session = session::open(&session).await?;
    let versions = publish::list(&session, model).await?;
    if json {
        println!("{}", serde_json::to_string_pretty(&versions)?);
    } else {
        println!("{}", publish::table(&versions));
    }
    session.close().await.map_err(|e| anyhow!(e))
}

async fn promote(PromoteArgs { model, version, session }: PromoteArgs) -> anyhow::Result<()> {
    let session = session::open(&session).await?;
    let promoted = publish::promote(&session, model, version).await?;
    println!("{} {} is promoted", promoted.model, promoted.version);
    session.close().await.map_err(|e| anyhow!(e))
}

async fn rollback(RollbackArgs { model, session }: RollbackArgs) -> anyhow::Result<()> {
    let session = session::open(&session).await?;
    let promoted = publish::roll_back(&session, model).await?;
    println!("{} {} is promoted", promoted.model, promoted.version);
    session.close().await.map_err(|e| anyhow!(e))
}
