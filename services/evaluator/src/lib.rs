//! Measures first-attempt success: closes the loop between simulator workers and the planner, records every trial, and
//! reports rates with their confidence intervals.
//!
//! Every model is run on the same variations (`queue`), one trial at a time on each worker (`schedule`, `trial`). The
//! records (`record`, `filmstrip`) are all that the report (`summary`, `table`, `report`) is made from, so that a run
//! can be interrupted and gone on with. What the planner was asked in an episode can be asked again (`replay`).

mod chart;
mod cli;
mod filmstrip;
mod presence;
mod progress;
mod queue;
mod record;
mod replay;
mod report;
mod schedule;
mod summary;
mod table;
mod trial;

pub use cli::{Cli, Command, ReplayArgs, ReportArgs, RunArgs};
pub use record::{Episode, FORMAT, Folder, GoalSource, Model, Outcome, Run, StageTimes, Trial};
pub use replay::{Difference, Replay, replay};
pub use summary::{Row, Summary, Training};
pub use table::table;

use anyhow::{Context, bail, ensure};
use backon::{ConstantBuilder, Retryable};
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};
use wire::planner::{ListModelsRequest, ListModelsResponse};
use wire::{Code, Message, key, query};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;

/// Runs what is missing of an evaluation, and reports.
///
/// # Errors
/// If planner and workers do not come up, a model or task is unknown, the folder cannot be used, or the user
/// interrupts. A trial that fails for reasons of its own is no error here: the summary counts it.
pub async fn run(args: &RunArgs) -> anyhow::Result<Summary> {
    for (option, names) in [("--models", &args.models), ("--tasks", &args.tasks)] {
        let distinct: BTreeSet<_> = names.iter().collect();
        ensure!(distinct.len() == names.len(), "{option}: expected every name once, got {}", names.join(","));
    }
    let patience = Duration::from_secs(args.wait_secs);
    let timeout = Duration::from_secs(args.timeout_secs);
    let session = service_kit::session::open(&args.session).await?;
    let mut alive = presence::follow(&session, &args.planner).await?;
    presence::wait(&mut alive, &args.planner, args.workers, patience).await?;

    let run = Run {
        format: FORMAT,
        title: args.title.clone(),
        command: command_line(),
        date: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
        planner: args.planner.clone(),
        models: models(&session, &args.planner, &args.models, timeout).await?,
        tasks: args.tasks.clone(),
        trials: args.trials,
        first_seed: args.first_seed,
        goal: args.goal,
    };
    let folder = Folder::new(&args.out);
    folder.check_goal(args.goal)?;
    folder.write_run(&run)?;
    let link = trial::Link { session: session.clone(), planner: args.planner.clone(), timeout };
    schedule::Schedule::new(Arc::new(run), folder, link)?.drive(alive, patience).await?;
    // What is reported is in the folder by now.
    if let Err(error) = session.close().await {
        tracing::warn!("closing the zenoh session: {error}");
    }
    report(&args.out)
}

/// Reports from the records of a run.
///
/// # Errors
/// If the folder holds no run, or a file cannot be read or written.
pub fn report(out: &Path) -> anyhow::Result<Summary> {
    let folder = Folder::new(out);
    let run = folder.read_run()?;
    let trials = folder.trials(&run)?;
    let summary = Summary::new(run, &trials);
    record::write_json(&folder.path("summary.json"), &summary)?;
    let html = report::html(&summary, &trials, &folder)?;
    service_kit::files::write_atomically(&folder.path("report.html"), html.as_bytes())?;
    tracing::info!("the report is {}", folder.path("report.html").display());
    Ok(summary)
}

/// The named models as the planner serves them, or all of them if none is named.
async fn models(session: &Session, planner: &str, names: &[String], timeout: Duration) -> anyhow::Result<Vec<Model>> {
    let key = key::planner_list_models(planner)?;
    let response: ListModelsResponse = ask(session, &key, ListModelsRequest, timeout)
        .await
        .with_context(|| format!("asking planner \"{planner}\" for its models"))?;
    let served = response.models;
    let known = || served.iter().map(|model| model.name.as_str()).collect::<Vec<_>>().join(", ");
    if served.is_empty() {
        bail!("planner \"{planner}\" serves no model");
    }
    if names.is_empty() {
        return Ok(served.into_iter().map(Model::from).collect());
    }
    let find = |name: &String| {
        let model = served.iter().find(|model| model.name == *name).cloned().map(Model::from);
        model.with_context(|| format!("--models: planner \"{planner}\" serves {}; got {name}", known()))
    };
    names.iter().map(find).collect()
}

/// Asks a planner that has only just been found: right after connecting, its services may not be known yet.
async fn ask<Q: Message + Clone, R: Message>(
    session: &Session,
    key: &OwnedKeyExpr,
    request: Q,
    timeout: Duration,
) -> Result<R, wire::Error> {
    let again = ConstantBuilder::default().with_delay(Duration::from_millis(200)).with_max_times(10);
    let call = || query::call(session, key, request.clone(), timeout);
    call.retry(again).when(|error: &wire::Error| error.code == Code::Unavailable).await
}

/// What was typed, fit to be typed again.
fn command_line() -> String {
    let quoted = |argument: String| {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_=./:,@+".contains(c);
        if argument.chars().all(plain) && !argument.is_empty() {
            argument
        } else {
            format!("'{}'", argument.replace('\'', r"'\''"))
        }
    };
    std::env::args().map(quoted).collect::<Vec<_>>().join(" ")
}
