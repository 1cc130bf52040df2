//! Client of the service's training runs, with a progress bar for terminals.

use crate::training::progress::{Bar, Observer};
use anyhow::Context;
use service_kit::network::{self, Retry};
use service_kit::session::IntoAnyhow;
use std::time::Duration;
use wire::training::{
    ListRunsRequest, ListRunsResponse, Run, RunState, StartRunRequest, StartRunResponse, StopRunRequest,
    StopRunResponse,
};
use wire::{Code, Error, Message, key};
use zenoh::Session;
use zenoh::handlers::RingChannel;
use zenoh::key_expr::OwnedKeyExpr;

/// Timeout of an answer; a run may take half a minute to stop.
const TIMEOUT: Duration = Duration::from_secs(60);
/// Retries while the trainer is unavailable: it may not be discovered yet.
const RETRY: Retry = Retry {
    delays: [Duration::from_millis(500); 2],
    patience: Duration::from_secs(2),
    when: |error| error.code == Code::Unavailable,
};
/// Time without a publication after which a run's state is queried.
const SILENCE: Duration = Duration::from_secs(5);

/// Starts a run at the trainer of this name.
///
/// # Errors
/// If the trainer refuses the run, or does not answer.
pub async fn start(session: &Session, trainer: &str, request: StartRunRequest) -> Result<Run, Error> {
    let answer: StartRunResponse = ask(session, &key::trainer_start_run(trainer)?, request).await?;
    Ok(answer.run)
}

/// Stops a run, and returns its final state.
///
/// # Errors
/// If the run is unknown or not running, or the trainer does not answer.
pub async fn stop(session: &Session, trainer: &str, name: String) -> Result<Run, Error> {
    let request = StopRunRequest { name };
    let answer: StopRunResponse = ask(session, &key::trainer_stop_run(trainer)?, request).await?;
    Ok(answer.run)
}

/// Lists all runs, ordered by name.
///
/// # Errors
/// If no trainer of this name answers.
pub async fn list(session: &Session, trainer: &str) -> Result<Vec<Run>, Error> {
    let answer: ListRunsResponse = ask(session, &key::trainer_list_runs(trainer)?, ListRunsRequest).await?;
    Ok(answer.runs)
}

/// Shows the progress of a run until it ends, and returns its final state.
///
/// # Errors
/// If the run is unknown, the trainer no longer answers, or a publication is malformed.
pub async fn watch(session: &Session, trainer: &str, name: &str) -> anyhow::Result<Run> {
    // Subscribed before the first query, so that no change in between is missed. Only the latest publication matters.
    let published = session.declare_subscriber(key::training_progress(name)?).with(RingChannel::new(1));
    let published = published.await.into_anyhow()?;

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
            Ok(sample) => wire::decode(&sample.into_anyhow()?.payload().to_bytes())?,
            // The step is slow, or the trainer is gone.
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

async fn ask<Q: Message + Clone, R: Message>(session: &Session, key: &OwnedKeyExpr, request: Q) -> Result<R, Error> {
    network::ask(session, key, request, TIMEOUT, RETRY).await
}
