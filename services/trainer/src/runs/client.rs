//! The other side of the service's training runs: asking for them, and watching them on a terminal.

use crate::training::progress::{Bar, Observer};
use anyhow::{Context, anyhow};
use backon::{ConstantBuilder, Retryable};
use std::time::Duration;
use wire::training::{
    ListRunsRequest, ListRunsResponse, Run, RunState, StartRunRequest, StartRunResponse, StopRunRequest,
    StopRunResponse,
};
use wire::{Code, Error, Message, key, query};
use zenoh::Session;
use zenoh::handlers::RingChannel;
use zenoh::key_expr::OwnedKeyExpr;

/// How long an answer may take; a run that is stopped may take half a minute to end.
const TIMEOUT: Duration = Duration::from_secs(60);
/// How long nothing may be heard of a run before it is asked for.
const SILENCE: Duration = Duration::from_secs(5);

/// Starts a run of the trainer of this name.
///
/// # Errors
/// Why there is none.
pub async fn start(session: &Session, trainer: &str, request: StartRunRequest) -> Result<Run, Error> {
    let answer: StartRunResponse = ask(session, &key::trainer_start_run(trainer)?, request).await?;
    Ok(answer.run)
}

/// Stops a run; answers how it ended.
///
/// # Errors
/// Why it is not stopped.
pub async fn stop(session: &Session, trainer: &str, name: String) -> Result<Run, Error> {
    let request = StopRunRequest { name };
    let answer: StopRunResponse = ask(session, &key::trainer_stop_run(trainer)?, request).await?;
    Ok(answer.run)
}

/// Every run, by name.
///
/// # Errors
/// If no trainer of this name answers.
pub async fn list(session: &Session, trainer: &str) -> Result<Vec<Run>, Error> {
    let answer: ListRunsResponse = ask(session, &key::trainer_list_runs(trainer)?, ListRunsRequest).await?;
    Ok(answer.runs)
}

/// Shows the progress of a run until it runs no more; answers how it ended.
///
/// # Errors
/// If there is no such run, the trainer goes away, or what is published is not the run's progress.
pub async fn watch(session: &Session, trainer: &str, name: &str) -> anyhow::Result<Run> {
    // What changes after the run was asked for is heard, as it is listened for already. Only the latest is of interest.
    let published = session.declare_subscriber(key::training_progress(name)?).with(RingChannel::new(1));
    let published = published.await.map_err(|e| anyhow!(e))?;
    let mut run = get(session, trainer, name).await?;
    let mut bar = Bar::new(name);
    bar.begin(run.progress.map_or(0, |progress| progress.step))?;
    loop {
        if let Some(progress) = &run.progress {
            bar.observe(progress)?;
        }
        if run.state != RunState::Running {
            return Ok(run);
        }
        run = match tokio::time::timeout(SILENCE, published.recv_async()).await {
            Ok(sample) => wire::decode(&sample.map_err(|e| anyhow!(e))?.payload().to_bytes())?,
            // A step takes long, or the trainer has gone.
            Err(_) => get(session, trainer, name).await?,
        };
    }
}

async fn get(session: &Session, trainer: &str, name: &str) -> anyhow::Result<Run> {
    let mut runs = list(session, trainer).await?;
    let names: Vec<_> = runs.iter().map(|run| run.name.clone()).collect();
    let index = names.iter().position(|known| known == name);
    let index = index.with_context(|| format!("name: expected one of {names:?}, got {name:?}"))?;
    Ok(runs.swap_remove(index))
}

/// Asks again if nobody serves the key: the trainer may not be found yet.
async fn ask<Q: Message + Clone, R: Message>(session: &Session, key: &OwnedKeyExpr, request: Q) -> Result<R, Error> {
    let again = ConstantBuilder::default().with_delay(Duration::from_millis(500)).with_max_times(4);
    let ask = || query::call(session, key, request.clone(), TIMEOUT);
    ask.retry(again).when(|error: &Error| error.code == Code::Unavailable).await
}
