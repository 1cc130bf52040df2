//! Zenoh transport of training runs: queryables, and publication of progress.

use crate::runs::Runs;
use crate::service::{CHANGES, PLACES};
use anyhow::ensure;
use service_kit::network::{Places, Server};
use tokio::runtime::Handle;
use tokio_util::task::AbortOnDropHandle;
use tracing::warn;
use wire::training::{
    ListRunsRequest, ListRunsResponse, StartRunRequest, StartRunResponse, StopRunRequest, StopRunResponse,
};
use wire::{encode, key, query};
use zenoh::Session;

/// Queryables and publisher of training runs, undeclared when dropped.
#[derive(Debug)]
pub(crate) struct RunsZenoh {
    _server: Server<Runs>,
    _publisher: AbortOnDropHandle<()>,
}

/// Declares the queryables of the trainer of this name, and publishes every change of its runs.
///
/// # Errors
/// If the name is not valid in a key, or zenoh refuses a declaration.
pub(crate) async fn start(session: &Session, name: &str, runs: &Runs) -> anyhow::Result<RunsZenoh> {
    let key = key::trainer_start_run(name)?;
    ensure!(!key.is_wild(), "name: expected that of one trainer, got {name:?}");
    let mut server = Server::new(session, runs.clone());
    let places = || Places::new(PLACES);

    let start = |runs: &Runs, request: StartRunRequest| Ok(StartRunResponse { run: runs.start(&request)? });
    server.serve_change(key, &places(), (CHANGES, "start_run"), start).await?;

    let stop = |runs: &Runs, request: StopRunRequest| {
        let run = Handle::current().block_on(runs.stop(&request.name))?;
        Ok(StopRunResponse { run })
    };
    server.serve_change(key::trainer_stop_run(name)?, &places(), (CHANGES, "stop_run"), stop).await?;

    let list = |runs: &Runs, _: ListRunsRequest| Ok(ListRunsResponse { runs: runs.list() });
    server.serve(key::trainer_list_runs(name)?, &places(), list).await?;

    let publisher = AbortOnDropHandle::new(tokio::spawn(publish(session.clone(), runs.clone())));
    Ok(RunsZenoh { _server: server, _publisher: publisher })
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
