//! Zenoh transport of training runs: queryables, and publication of progress.

use crate::queries::serve;
use crate::runs::Runs;
use crate::service::CHANGES;
use anyhow::{anyhow, ensure};
use tokio::runtime::Handle;
use tokio_util::task::AbortOnDropHandle;
use tracing::warn;
use wire::training::{
    ListRunsRequest, ListRunsResponse, StartRunRequest, StartRunResponse, StopRunRequest, StopRunResponse,
};
use wire::{Error, encode, key, query};
use zenoh::Session;
use zenoh::query::{Query, Queryable};

/// Queryables and publisher of training runs, undeclared when dropped.
#[derive(Debug)]
pub(crate) struct RunsZenoh {
    _queryables: [Queryable<()>; 3],
    _publisher: AbortOnDropHandle<()>,
}

/// Declares the queryables of the trainer of this name, and publishes every change of its runs.
///
/// # Errors
/// If the name is not valid in a key, or zenoh refuses a declaration.
pub(crate) async fn start(session: &Session, name: &str, runs: &Runs) -> anyhow::Result<RunsZenoh> {
    let key = key::trainer_start_run(name)?;
    ensure!(!key.is_wild(), "name: expected that of one trainer, got {name:?}");
    let zenoh = |e: zenoh::Error| anyhow!(e);
    let [start_key, stop_key, list_key] = [key, key::trainer_stop_run(name)?, key::trainer_list_runs(name)?];

    let (core, own) = (runs.clone(), start_key.clone());
    let start = move |query: &Query| {
        let answer = query::request(query).and_then(|request: StartRunRequest| core.start(&request));
        report_refusal("start_run", query, &answer);
        query::reply_as(query, &own, answer.map(|run| StartRunResponse { run }))
    };
    let (core, own, runtime) = (runs.clone(), stop_key.clone(), Handle::current());
    let stop = move |query: &Query| {
        let stop = |request: StopRunRequest| runtime.block_on(core.stop(&request.name));
        let answer = query::request(query).and_then(stop);
        report_refusal("stop_run", query, &answer);
        query::reply_as(query, &own, answer.map(|run| StopRunResponse { run }))
    };
    let (core, own) = (runs.clone(), list_key.clone());
    let list = move |query: &Query| {
        let answer = query::request(query).map(|_: ListRunsRequest| ListRunsResponse { runs: core.list() });
        query::reply_as(query, &own, answer)
    };

    let queryables = [
        serve(session, start_key, false, start).await.map_err(zenoh)?,
        serve(session, stop_key, false, stop).await.map_err(zenoh)?,
        serve(session, list_key, false, list).await.map_err(zenoh)?,
    ];
    let publisher = AbortOnDropHandle::new(tokio::spawn(publish(session.clone(), runs.clone())));
    Ok(RunsZenoh { _queryables: queryables, _publisher: publisher })
}

/// Logs and counts a refused change.
fn report_refusal<R>(change: &'static str, query: &Query, answer: &Result<R, Error>) {
    if let Err(error) = answer {
        CHANGES.refused(change, query.key_expr(), error);
    }
}

async fn publish(session: Session, runs: Runs) {
    let mut changes = runs.changes();
    while let Some(changed) = changes.next().await {
        for run in changed {
            let name = run.name.clone();
            let put = async {
                let key = key::training_progress(&name)?;
                session.put(key, encode(run)).encoding(query::encoding::<wire::proto::Run>()).await
            };
            if let Err(error) = put.await {
                warn!(run = name, %error, "progress not published");
            }
        }
    }
}
