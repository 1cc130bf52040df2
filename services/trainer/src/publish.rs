//! Publishing over zenoh: planners are told which version of each model to serve and fetch it piece by piece; people list,
//! promote and roll back.

use crate::service::CHANGES;
use crate::versions::Versions;
use anyhow::anyhow;
use backon::{ConstantBuilder, Retryable};
use comfy_table::{CellAlignment, LineStyle, Table, presets};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::{debug, warn};
use wire::checkpoint::{
    CheckpointManifest, CheckpointVersion, ListVersionsRequest, ListVersionsResponse, PromoteVersionRequest,
    PromoteVersionResponse, RollBackRequest, RollBackResponse,
};
use wire::{Code, Error, Message, encode, key, query};
use zenoh::Session;
use zenoh::handlers::FifoChannelHandler;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};

/// How often the folder of checkpoints is looked at.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// How long an answer may take.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Announces the promoted version of every model to every planner, those to come included, and answers what is asked of
/// the versions; when this returns, it does. The tasks end with the session, or with the reason why they cannot go on.
///
/// # Errors
/// If zenoh refuses a declaration.
pub async fn start(session: &Session, versions: &Arc<Versions>) -> anyhow::Result<JoinSet<anyhow::Result<()>>> {
    let mut tasks = JoinSet::new();
    serve(&mut tasks, session, (key::checkpoint_chunk("*")?, None), versions, Versions::chunk).await?;
    serve(&mut tasks, session, (key::checkpoint_list_versions("*")?, None), versions, Versions::list).await?;
    serve(&mut tasks, session, (key::checkpoint_promote("*")?, Some("promote")), versions, Versions::promote).await?;
    let roll_back = (key::checkpoint_roll_back("*")?, Some("roll_back"));
    serve(&mut tasks, session, roll_back, versions, Versions::roll_back).await?;
    let planners = session.liveliness().declare_subscriber(key::planner_alive("*")?).history(true);
    let planners = planners.await.map_err(|e| anyhow!(e))?;
    tasks.spawn(announce(session.clone(), planners, Arc::clone(versions)));
    tasks.spawn(take_in(Arc::clone(versions)));
    Ok(tasks)
}

/// Answers a queryable's requests, which may be for a change, one after the other, where they may block.
async fn serve<Q, R>(
    tasks: &mut JoinSet<anyhow::Result<()>>,
    session: &Session,
    (key, change): (OwnedKeyExpr, Option<&'static str>),
    versions: &Arc<Versions>,
    answer: fn(&Versions, Q) -> Result<R, Error>,
) -> anyhow::Result<()>
where
    Q: Message + 'static,
    R: Message + 'static,
{
    let queries = session.declare_queryable(key).complete(true).await.map_err(|e| anyhow!(e))?;
    let versions = Arc::clone(versions);
    tasks.spawn(async move {
        while let Ok(query) = queries.recv_async().await {
            let versions = Arc::clone(&versions);
            let answering = tokio::task::spawn_blocking(move || {
                let result = query::request(&query).and_then(|request| answer(&versions, request));
                if let (Some(change), Err(error)) = (change, &result) {
                    CHANGES.refused(change, query.key_expr(), error);
                }
                if let Err(error) = query::reply(&query, result) {
                    warn!(%error, key = %query.key_expr(), "answer not sent");
                }
            });
            answering.await?;
        }
        Ok(())
    });
    Ok(())
}

/// Tells planners what is promoted, whenever that changes or one of them appears. They pass over what they know.
async fn announce(
    session: Session,
    planners: Subscriber<FifoChannelHandler<Sample>>,
    versions: Arc<Versions>,
) -> anyhow::Result<()> {
    let mut promoted = versions.promoted();
    loop {
        let announcements: Vec<_> = promoted.borrow_and_update().values().cloned().collect();
        for announcement in announcements {
            let CheckpointManifest { model, version, digest, .. } = &announcement.manifest;
            debug!(model, version, digest, "announced");
            let key = key::checkpoint_announcement(model)?;
            session.put(key, encode(announcement)).await.map_err(|e| anyhow!(e))?;
        }
        if !news(&mut promoted, &planners).await {
            return Ok(());
        }
    }
}

/// Waits for another promotion or another planner; false once the session is closed.
async fn news<T>(promoted: &mut watch::Receiver<T>, planners: &Subscriber<FifoChannelHandler<Sample>>) -> bool {
    loop {
        tokio::select! {
            changed = promoted.changed() => return changed.is_ok(),
            token = planners.recv_async() => match token.map(|token| token.kind()) {
                Ok(SampleKind::Put) => return true,
                Ok(SampleKind::Delete) => {}
                Err(_) => return false,
            },
        }
    }
}

/// Looks again and again for checkpoints that training runs have written.
async fn take_in(versions: Arc<Versions>) -> anyhow::Result<()> {
    let mut poll = tokio::time::interval(POLL_INTERVAL);
    loop {
        poll.tick().await;
        let versions = Arc::clone(&versions);
        if let Err(error) = tokio::task::spawn_blocking(move || versions.take_in()).await? {
            warn!(error = format!("{error:#}"), "checkpoint folder not read");
        }
    }
}

/// The versions of a model, or of all, that a trainer keeps.
///
/// # Errors
/// `NOT_FOUND` for an unknown model; `UNAVAILABLE` if there is no trainer.
pub async fn list(session: &Session, model: Option<String>) -> Result<Vec<CheckpointVersion>, Error> {
    let key = key::checkpoint_list_versions(model.as_deref().unwrap_or("*"))?;
    let response: ListVersionsResponse = call(session, &key, ListVersionsRequest { model }).await?;
    Ok(response.versions)
}

/// Lets planners serve a version; answers what is promoted now.
///
/// # Errors
/// `NOT_FOUND` for an unknown model or version; `UNAVAILABLE` if there is no trainer.
pub async fn promote(session: &Session, model: String, version: u32) -> Result<CheckpointManifest, Error> {
    let key = key::checkpoint_promote(&model)?;
    let response: PromoteVersionResponse = call(session, &key, PromoteVersionRequest { model, version }).await?;
    Ok(response.manifest)
}

/// Lets planners serve the version that was promoted before; answers what is promoted now.
///
/// # Errors
/// `NOT_FOUND` for an unknown model; `FAILED_PRECONDITION` if none was; `UNAVAILABLE` if there is no trainer.
pub async fn roll_back(session: &Session, model: String) -> Result<CheckpointManifest, Error> {
    let key = key::checkpoint_roll_back(&model)?;
    let response: RollBackResponse = call(session, &key, RollBackRequest { model }).await?;
    Ok(response.manifest)
}

/// Asks a trainer, and for five seconds again if there is none: the session may have been opened just now. What may have
/// reached one is not asked again, as rolling back twice is not rolling back once.
async fn call<Q: Message + Clone, R: Message>(session: &Session, key: &OwnedKeyExpr, request: Q) -> Result<R, Error> {
    let patience = ConstantBuilder::default().with_delay(Duration::from_millis(200)).with_max_times(25);
    let ask = || query::call(session, key, request.clone(), TIMEOUT);
    ask.retry(patience).when(|error: &Error| error.code == Code::Unavailable).await
}

/// Versions for a terminal, the promoted one marked, with the first digits of their digests.
pub fn table(versions: &[CheckpointVersion]) -> Table {
    let mut table = Table::new();
    table.load_style(presets::UTF8_HORIZONTAL_ONLY.row_separator(LineStyle::none()));
    table.set_header(["model", "version", "promoted", "bytes", "digest", "configuration", "parents", "signed"]);
    let short = |digest: &String| digest[..digest.floor_char_boundary(12)].to_owned();
    for CheckpointVersion { manifest, promoted } in versions {
        let CheckpointManifest { model, version, digest, size_bytes, config_digest, parents, signature_bundle } =
            manifest;
        let parents = parents.iter().map(short).collect::<Vec<_>>().join(" ");
        let [promoted, signed] = [*promoted, signature_bundle.is_some()].map(|is| if is { "yes" } else { "" });
        let (version, bytes) = (version.to_string(), size_bytes.to_string());
        let (digest, config_digest) = (short(digest), short(config_digest));
        table.add_row([model.clone(), version, promoted.into(), bytes, digest, config_digest, parents, signed.into()]);
    }
    for column in [1, 3] {
        if let Some(column) = table.column_mut(column) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table
}
