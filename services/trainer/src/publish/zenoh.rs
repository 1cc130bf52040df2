//! Zenoh transport of publishing: announces promoted versions to planners, serves their checkpoints in chunks, and lists,
//! promotes and rolls back versions.

use crate::publish::versions::Versions;
use crate::queries;
use crate::service::CHANGES;
use anyhow::anyhow;
use backon::{ConstantBuilder, Retryable};
use comfy_table::{CellAlignment, LineStyle, Table, presets};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tracing::{debug, warn};
use wire::checkpoint::{
    CheckpointManifest, CheckpointVersion, ListVersionsRequest, ListVersionsResponse, PromoteVersionRequest,
    PromoteVersionResponse, RollBackRequest, RollBackResponse,
};
use wire::{Code, Error, Message, encode, key, query};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Sample, SampleKind};

/// Polling interval of the folder of checkpoints.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// Timeout of an answer.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Queryables and announcements of the versions, which end when this is dropped.
#[derive(Debug)]
pub(crate) struct Publisher {
    _queryables: [Queryable<()>; 4],
    /// Tasks that end only with an error.
    pub(crate) tasks: JoinSet<anyhow::Result<()>>,
}

/// Starts announcing the promoted version of each model to all planners, present and future, and serving the versions; when
/// this returns, queries are answered.
///
/// # Errors
/// If zenoh refuses a declaration.
pub(crate) async fn start(session: &Session, versions: &Arc<Versions>) -> anyhow::Result<Publisher> {
    let queryables = [
        serve(session, key::checkpoint_chunk("*")?, None, versions, Versions::chunk).await?,
        serve(session, key::checkpoint_list_versions("*")?, None, versions, Versions::list).await?,
        serve(session, key::checkpoint_promote("*")?, Some("promote"), versions, Versions::promote).await?,
        serve(session, key::checkpoint_roll_back("*")?, Some("roll_back"), versions, Versions::roll_back).await?,
    ];

    let mut tasks = JoinSet::new();
    tasks.spawn(announce(session.clone(), Arc::clone(versions)));
    tasks.spawn(take_in(Arc::clone(versions)));
    Ok(Publisher { _queryables: queryables, tasks })
}

/// Declares a queryable, of a state `change` if there is one.
async fn serve<Q, R>(
    session: &Session,
    key: OwnedKeyExpr,
    change: Option<&'static str>,
    versions: &Arc<Versions>,
    answer: fn(&Versions, Q) -> Result<R, Error>,
) -> anyhow::Result<Queryable<()>>
where
    Q: Message + 'static,
    R: Message + 'static,
{
    let versions = Arc::clone(versions);
    let answer = move |query: &Query| {
        let result = query::request(query).and_then(|request| answer(&versions, request));
        if let (Some(change), Err(error)) = (change, &result) {
            CHANGES.refused(change, query.key_expr(), error);
        }
        query::reply(query, result)
    };
    queries::serve(session, key, true, answer).await.map_err(|e| anyhow!(e))
}

/// Announces all promoted versions whenever one changes or a planner appears; planners ignore repeated announcements.
async fn announce(session: Session, versions: Arc<Versions>) -> anyhow::Result<()> {
    let appeared = Arc::new(Notify::new());
    let notify = Arc::clone(&appeared);
    let on_token = move |token: Sample| {
        if token.kind() == SampleKind::Put {
            notify.notify_one();
        }
    };
    let planners = session.liveliness().declare_subscriber(key::planner_alive("*")?).history(true);
    let _planners = planners.callback(on_token).await.map_err(|e| anyhow!(e))?;

    let mut promoted = versions.promoted();
    loop {
        let announcements: Vec<_> = promoted.borrow_and_update().values().cloned().collect();
        for announcement in announcements {
            let CheckpointManifest { model, version, digest, .. } = &announcement.manifest;
            debug!(model, version, digest, "announced");
            let key = key::checkpoint_announcement(model)?;
            session.put(key, encode(announcement)).await.map_err(|e| anyhow!(e))?;
        }
        tokio::select! {
            changed = promoted.changed() => changed?,
            () = appeared.notified() => {}
        }
    }
}

/// Polls for new checkpoints of training runs.
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

/// Lists a trainer's versions of a model, or of all models.
///
/// # Errors
/// `NOT_FOUND` for an unknown model; `UNAVAILABLE` if there is no trainer.
pub async fn list(session: &Session, model: Option<String>) -> Result<Vec<CheckpointVersion>, Error> {
    let key = key::checkpoint_list_versions(model.as_deref().unwrap_or("*"))?;
    let response: ListVersionsResponse = call(session, &key, ListVersionsRequest { model }).await?;
    Ok(response.versions)
}

/// Promotes a version, and returns its manifest.
///
/// # Errors
/// `NOT_FOUND` for an unknown model or version; `UNAVAILABLE` if there is no trainer.
pub async fn promote(session: &Session, model: String, version: u32) -> Result<CheckpointManifest, Error> {
    let key = key::checkpoint_promote(&model)?;
    let response: PromoteVersionResponse = call(session, &key, PromoteVersionRequest { model, version }).await?;
    Ok(response.manifest)
}

/// Promotes the previously promoted version, and returns its manifest.
///
/// # Errors
/// `NOT_FOUND` for an unknown model; `FAILED_PRECONDITION` if no version was promoted before; `UNAVAILABLE` if there is no
/// trainer.
pub async fn roll_back(session: &Session, model: String) -> Result<CheckpointManifest, Error> {
    let key = key::checkpoint_roll_back(&model)?;
    let response: RollBackResponse = call(session, &key, RollBackRequest { model }).await?;
    Ok(response.manifest)
}

/// Calls a trainer, with retries for five seconds while there is none, since the session may be new. A request that may have
/// arrived is not repeated: rolling back is not idempotent.
async fn call<Q: Message + Clone, R: Message>(session: &Session, key: &OwnedKeyExpr, request: Q) -> Result<R, Error> {
    let retries = ConstantBuilder::default().with_delay(Duration::from_millis(200)).with_max_times(25);
    let ask = || query::call(session, key, request.clone(), TIMEOUT);
    ask.retry(retries).when(|error: &Error| error.code == Code::Unavailable).await
}

/// Table of versions for a terminal, with abbreviated digests.
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
