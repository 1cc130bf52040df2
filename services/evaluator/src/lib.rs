//! Measures first-attempt success: closes the loop between simulator workers and planners, records every trial, and
//! reports rates with their confidence intervals.
//!
//! Every model, and every control (`control`), is run on the same variations (`queue`), one trial at a time on each worker
//! (`schedule`, `trial`, `actor`), spread over the planners (`planners`), with plans as they are set (`planning`). Outages of routers and services are waited for (`link`, `presence`), or the trial begins
//! anew from its seed, so that the results are the same as without. The records (`record`) are all that the
//! report (`summary`, `table`, `report`, `filmstrip`) is made from, so that a run can be interrupted and gone on with. Two
//! models on the same variations are compared by them (`compare`, `paired`). What a planner was asked in an episode can be asked
//! again (`replay`).

mod actor;
mod chart;
mod cli;
mod compare;
mod control;
mod filmstrip;
mod link;
mod paired;
mod planners;
mod planning;
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
mod watchers;

pub use cli::{Cli, Command, CompareArgs, ReplayArgs, ReportArgs, RunArgs};
pub use compare::{Comparison, Source, Sources, TaskComparison, compare};
pub use paired::Counts;
pub use planning::{Planning, Solver};
pub use record::{Episode, FORMAT, Folder, GoalSource, Model, Outcome, Run, StageTimes, Trial};
pub use replay::{Difference, Replay, replay};
pub use summary::{Row, Summary, Training};
pub use table::{comparison_table, table};

use anyhow::{Context, bail, ensure};
use control::Control;
use link::Link;
use record::FIRST_EVALUATION_SEED;
use service_kit::network;
use service_kit::session::Connection;
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};
use tokio::time::Instant;
use wire::key;
use wire::planner::{ListModelsRequest, ListModelsResponse, ModelInfo};
use zenoh::Session;

/// Pause before planners whose models differ are asked again.
const MODELS_PERIOD: Duration = Duration::from_secs(1);

/// Runs what is missing of an evaluation, and reports.
///
/// # Errors
/// If router, planners and workers do not come up, the planners differ, a model or task is unknown or they do not fit, the
/// folder cannot be used or another run has it, or the user interrupts. A trial that fails for reasons of its own is no error here: the summary counts it.
pub async fn run(args: &RunArgs) -> anyhow::Result<Summary> {
    for (option, names) in [("--planner", &args.planner), ("--models", &args.models), ("--tasks", &args.tasks)] {
        ensure!(names.iter().all(|name| !name.is_empty()), "{option}: expected names, got {:?}", names.join(","));
        let distinct: BTreeSet<_> = names.iter().collect();
        ensure!(distinct.len() == names.len(), "{option}: expected every name once, got {}", names.join(","));
    }
    args.planning.check().context("--solver, --updates, --samples")?;
    let folder = Folder::new(&args.out);
    let _keeper = folder.take_over()?;
    folder.check_settings(args.goal, &args.planning)?;

    let patience = Duration::from_secs(args.wait_secs);
    let timeout = Duration::from_secs(args.timeout_secs);
    let start = Instant::now();
    let session = link::join(&args.session, patience).await?;
    let connection = Connection::follow(&session, &args.session);
    let mut alive = presence::follow(&session, &args.planner).await?;
    presence::wait(&session, &mut alive, &args.planner, args.workers, start, patience).await?;

    let run = Run {
        format: FORMAT,
        title: args.title.clone(),
        command: command_line(),
        date: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
        planners: args.planner.clone(),
        models: models(&session, &args.planner, &args.models, timeout, patience).await?,
        tasks: args.tasks.clone(),
        trials: args.trials,
        first_seed: args.first_seed,
        goal: args.goal,
        planning: args.planning,
    };
    check_planning(&run)?;
    if run.has_demonstration_seeds() {
        tracing::warn!(
            "--first-seed: seeds below {FIRST_EVALUATION_SEED} are those of demonstrations, which models may have been \
             trained on; the report says so"
        );
    }
    let recovery = Duration::from_secs(args.recovery_secs);
    let link = Link { session: session.clone(), timeout, recovery, alive };
    let run = Arc::new(run);
    let schedule = schedule::Schedule::new(run.clone(), folder.clone(), link)?;
    schedule.check().await?;
    folder.write_run(&run)?;
    schedule.drive(patience).await?;
    // A session that closes is no outage to be warned of.
    drop(connection);
    // The report reads the records in the folder.
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

/// The named models, or all of the first planner if none is named, as every planner serves them. Waits while planners differ:
/// one may still be fetching a checkpoint that was published a moment ago.
async fn models(
    session: &Session,
    planners: &[String],
    names: &[String],
    timeout: Duration,
    patience: Duration,
) -> anyhow::Result<Vec<Model>> {
    let start = Instant::now();
    loop {
        let mut served = Vec::new();
        for planner in planners {
            let key = key::planner_list_models(planner)?;
            // Right after connecting, the services of a planner that is alive may not be known yet.
            let retry = link::retry(patience);
            let response: ListModelsResponse = network::ask(session, &key, ListModelsRequest, timeout, retry)
                .await
                .with_context(|| format!("asking planner \"{planner}\" for its models"))?;
            served.push((planner.as_str(), response.models));
        }
        let served_by_one =
            |name: &String| served.iter().any(|(_, models)| models.iter().any(|model| model.name == *name));
        let may_come = |name: &String| served_by_one(name) != Control::named(name).is_some();
        match same_models(&served, names) {
            Ok(models) => return Ok(models),
            Err(error) if start.elapsed() >= patience || !names.iter().all(may_come) => return Err(error),
            Err(error) => tracing::info!("waiting up to {} s: {error:#}", patience.as_secs()),
        }
        tokio::time::sleep(MODELS_PERIOD).await;
    }
}

fn same_models(served: &[(&str, Vec<ModelInfo>)], names: &[String]) -> anyhow::Result<Vec<Model>> {
    let Some(((first, first_models), others)) = served.split_first() else { return Ok(Vec::new()) };
    for (planner, models) in served {
        let taken = models.iter().find(|model| names.contains(&model.name) && Control::named(&model.name).is_some());
        if let Some(ModelInfo { name, .. }) = taken {
            bail!(
                "--models: expected {name} to be the control only, got a model of that name from planner \"{planner}\""
            );
        }
    }
    let models = selected(first, first_models, names)?;
    for (planner, other_models) in others {
        check_same(first, &models, planner, other_models)?;
    }
    Ok(models)
}

/// The named models, or all if none is named.
fn selected(planner: &str, served: &[ModelInfo], names: &[String]) -> anyhow::Result<Vec<Model>> {
    ensure!(!served.is_empty(), "planner \"{planner}\" serves no model");
    if names.is_empty() {
        return Ok(served.iter().cloned().map(Model::from).collect());
    }
    let find = |name: &String| {
        if let Some(control) = Control::named(name) {
            return Ok(control.model());
        }
        let model = served.iter().find(|model| model.name == *name).cloned().map(Model::from);
        model.with_context(|| format!("--models: planner \"{planner}\" serves {}; got {name}", listed(served)))
    };
    names.iter().map(find).collect()
}

/// Checks that a planner serves the models as the first one does.
fn check_same(first: &str, expected: &[Model], planner: &str, served: &[ModelInfo]) -> anyhow::Result<()> {
    for Model { name, digest, .. } in expected.iter().filter(|model| Control::of(model).is_none()) {
        let Some(got) = served.iter().find(|model| model.name == *name) else {
            bail!(
                "--planner: expected planner \"{planner}\" to serve {name} as planner \"{first}\" does, got {}",
                listed(served)
            );
        };
        ensure!(
            got.digest == *digest,
            "--planner: expected planner \"{planner}\" to serve {name} from checkpoint {digest} as planner \"{first}\" does, \
             got {}",
            got.digest
        );
    }
    Ok(())
}

/// Checks that what is asked for of plans suits the models.
fn check_planning(Run { models, planning, .. }: &Run) -> anyhow::Result<()> {
    let listed = || models.iter().map(|model| model.name.as_str()).collect::<Vec<_>>().join(", ");
    let asked = planning.search().is_some() || planning.warm_start;
    ensure!(!asked || models.iter().any(Model::plans), "{planning}: expected a model that plans, got {}", listed());
    // The controls plan an action at a time.
    let short = models.iter().find(|model| !model.is_control() && model.horizon < planning.apply_actions);
    if let Some(Model { name, horizon, .. }) = short {
        bail!("--apply-actions: expected at most {horizon}, the horizon of {name}, got {}", planning.apply_actions);
    }
    Ok(())
}

fn listed(served: &[ModelInfo]) -> String {
    served.iter().map(|model| model.name.as_str()).collect::<Vec<_>>().join(", ")
}

/// The command line, quoted for a shell.
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
