//! `cpn-trainer`: the service that records demonstrations, publishes checkpoints and starts training runs; the training run
//! itself; and commands for the service and for recordings.

mod cli;

use anyhow::{anyhow, bail, ensure};
use cli::{
    Cli, Command, MirrorArgs, PresetArgs, PromoteArgs, ReplayArgs, RollbackArgs, RunsArgs, ServeArgs, StartArgs,
    StopArgs, TrainerArgs, VerifyArgs, VersionsArgs, WatchArgs,
};
use comfy_table::{LineStyle, Table, presets};
use cpn::Preset;
use serde::Deserialize;
use serde::de::{IntoDeserializer, value};
use service_kit::session::{IntoAnyhow, SessionConfig};
use service_kit::{config, output, session, shutdown, telemetry};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use trainer::record::folder::Recordings;
use trainer::record::{mirror, send, verify};
use trainer::runs::client;
use trainer::training::allocator;
use trainer::training::config::Config;
use trainer::training::journal::Journal;
use trainer::training::progress::{Bar, JsonLines, Observer, StopIf, print_line};
use trainer::training::run::{self, Outcome};
use trainer::{publish, service};
use wire::training::{Run, RunState, StartRunRequest};
use zenoh::Session;

fn main() -> anyhow::Result<()> {
    service_kit::process::run(program())
}

async fn program() -> anyhow::Result<()> {
    let (cli, sources): (Cli, _) = config::parse_with_sources();
    let _telemetry = telemetry::init("cpn-trainer")?;
    match cli.command {
        Command::Serve(ServeArgs { file, config }) => {
            serve(config::load("CPN_TRAINER_", file.as_deref(), &config, &sources)?).await
        }
        Command::Train(arguments) => {
            allocator::keep()?;
            let config = Config::load(arguments.config.as_deref(), &arguments, &arguments.set)?;
            let enough = match arguments.demonstrations {
                Some(count) => gather(&config, count, &arguments.session).await?,
                None => true,
            };
            let outcome = if enough { train(config, arguments.json).await? } else { Outcome::Interrupted { step: 0 } };
            tell_outcome(&outcome, arguments.json)
        }
        Command::Preset(arguments) => print_preset(&arguments),
        Command::Start(arguments) => start(arguments).await,
        Command::Stop(arguments) => stop(arguments).await,
        Command::Runs(arguments) => runs(arguments).await,
        Command::Watch(arguments) => watch(arguments).await,
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

/// Mirrors demonstrations from the network until `count` are stored; false if a signal stopped it before.
async fn gather(config: &Config, count: usize, network: &SessionConfig) -> anyhow::Result<bool> {
    let recordings = Arc::new(Recordings::open(config.dataset.clone())?);
    let session = session::open(network).await?;

    let enough = tokio::select! {
        done = mirror::follow(&session, &recordings, count) => done.map(|()| true)?,
        signal = shutdown::requested() => signal.map(|()| false)?,
    };
    session.close().await.into_anyhow()?;
    tracing::info!(kept = recordings.count(), of = count, "demonstrations from the network");
    Ok(enough)
}

async fn train(config: Config, json: bool) -> anyhow::Result<Outcome> {
    let stop = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&stop);
    let mut run = tokio::task::spawn_blocking(move || {
        let stopped = StopIf(move |_| seen.load(Ordering::Relaxed));
        let shown: Box<dyn Observer> =
            if json { Box::new(JsonLines::default()) } else { Box::new(Bar::new(&config.name())) };
        let journal = Journal::open(config.run_dir(), &config.out)?;
        let mut observers: Vec<Box<dyn Observer>> = vec![Box::new(stopped), shown, Box::new(journal)];
        run::run(&config, &mut observers)
    });
    tokio::select! {
        outcome = &mut run => outcome?,
        signal = shutdown::requested() => {
            signal?;
            stop.store(true, Ordering::Relaxed);
            run.await?
        }
    }
}

fn tell_outcome(outcome: &Outcome, json: bool) -> anyhow::Result<()> {
    match outcome {
        Outcome::Finished { digest } => tracing::info!(digest, "checkpoint written"),
        Outcome::Interrupted { step } => tracing::info!(step, "interrupted; the same command goes on from here"),
    }
    if json { output::accept(print_line(outcome)) } else { Ok(()) }
}

fn print_preset(PresetArgs { name }: &PresetArgs) -> anyhow::Result<()> {
    let preset = Preset::deserialize(name.as_str().into_deserializer()).map_err(|e: value::Error| anyhow!(e))?;
    output::print(toml::to_string(&Config::from(preset))?)
}

async fn start(arguments: StartArgs) -> anyhow::Result<()> {
    let StartArgs { name, preset, hold_out, seed, settings, trainer } = arguments;
    let request = StartRunRequest { name, preset, hold_out, seed, settings: settings.join("\n") };
    let session = session::open(&trainer.session).await?;
    let run = client::start(&session, &trainer.trainer, request).await?;
    tell(session, &run).await
}

async fn stop(StopArgs { name, trainer }: StopArgs) -> anyhow::Result<()> {
    let session = session::open(&trainer.session).await?;
    let run = client::stop(&session, &trainer.trainer, name).await?;
    tell(session, &run).await
}

async fn watch(WatchArgs { name, trainer }: WatchArgs) -> anyhow::Result<()> {
    let session = session::open(&trainer.session).await?;
    let run = client::watch(&session, &trainer.trainer, &name).await?;
    tell(session, &run).await
}

async fn runs(RunsArgs { json, trainer: TrainerArgs { trainer, session } }: RunsArgs) -> anyhow::Result<()> {
    let session = session::open(&session).await?;
    let runs = client::list(&session, &trainer).await?;
    if json {
        output::print_line(serde_json::to_string_pretty(&runs)?)?;
    } else {
        let mut table = Table::new();
        table.load_style(presets::UTF8_HORIZONTAL_ONLY.row_separator(LineStyle::none()));
        table.set_header(["run", "state", "step", "of", "loss"]);
        for Run { name, state, progress } in &runs {
            let of = |value: fn(&trainer::training::progress::Progress) -> String| {
                progress.as_ref().map(value).unwrap_or_default()
            };
            let (step, steps) = (of(|p| p.step.to_string()), of(|p| p.steps.to_string()));
            table.add_row([name, state.name(), &step, &steps, &of(|p| format!("{:.4}", p.loss))]);
        }
        output::print_line(table)?;
    }
    session.close().await.into_anyhow()
}

/// Prints the state of a run; a failed run is an error.
async fn tell(session: Session, run: &Run) -> anyhow::Result<()> {
    session.close().await.into_anyhow()?;
    if let RunState::Failed { reason } = &run.state {
        bail!("{} failed: {reason}", run.name);
    }
    output::print_line(format_args!("{} is {}", run.name, run.state.name()))
}

async fn replay(ReplayArgs { dataset, tasks, session }: ReplayArgs) -> anyhow::Result<()> {
    let session = session::open(&session).await?;
    send::run(&session, &dataset, &tasks).await?;
    session.close().await.into_anyhow()
}

async fn mirror(MirrorArgs { dataset, once, session }: MirrorArgs) -> anyhow::Result<()> {
    let recordings = Arc::new(Recordings::open(dataset)?);
    let session = session::open(&session).await?;
    let work = async {
        if once {
            Ok(mirror::once(&session, &recordings).await?)
        } else {
            mirror::follow(&session, &recordings, usize::MAX).await
        }
    };
    tokio::select! {
        done = work => done?,
        signal = shutdown::requested() => signal?,
    }
    session.close().await.into_anyhow()
}

fn verify(VerifyArgs { dataset, tasks, episodes, json }: &VerifyArgs) -> anyhow::Result<()> {
    let report = verify::run(dataset, *tasks, *episodes)?;
    if *json {
        output::print_line(serde_json::to_string_pretty(&report)?)?;
    } else {
        output::print(&report)?;
    }
    ensure!(report.faults.is_empty(), "{}: {} faults", dataset.display(), report.faults.len());
    Ok(())
}

async fn versions(VersionsArgs { model, json, session }: VersionsArgs) -> anyhow::Result<()> {
    let session = session::open(&session).await?;
    let versions = publish::list(&session, model).await?;
    if json {
        output::print_line(serde_json::to_string_pretty(&versions)?)?;
    } else {
        output::print_line(publish::table(&versions))?;
    }
    session.close().await.into_anyhow()
}

async fn promote(PromoteArgs { model, version, session }: PromoteArgs) -> anyhow::Result<()> {
    let session = session::open(&session).await?;
    let promoted = publish::promote(&session, model, version).await?;
    output::print_line(format_args!("{} {} is promoted", promoted.model, promoted.version))?;
    session.close().await.into_anyhow()
}

async fn rollback(RollbackArgs { model, session }: RollbackArgs) -> anyhow::Result<()> {
    let session = session::open(&session).await?;
    let promoted = publish::roll_back(&session, model).await?;
    output::print_line(format_args!("{} {} is promoted", promoted.model, promoted.version))?;
    session.close().await.into_anyhow()
}
