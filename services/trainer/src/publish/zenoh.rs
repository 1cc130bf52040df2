//! Zenoh transport of publishing: announces promoted versions to planners, serves their checkpoints in chunks, and lists,
//! promotes and rolls back versions.

use crate::publish::versions::Versions;
use crate::service::{CHANGES, PLACES};
use comfy_table::{CellAlignment, LineStyle, Table, presets};
use service_kit::network::{self, Places, Retry, Server};
use service_kit::session::IntoAnyhow;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tracing::{debug, warn};
use wire::checkpoint::{
    CheckpointManifest, CheckpointVersion, ListVersionsRequest, ListVersionsResponse, PromoteVersionRequest,
    PromoteVersionResponse, RollBackRequest, RollBackResponse,
};
use wire::{Code, Error, Message, encode, key};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::sample::{Sample, SampleKind};

/// Polling interval of the folder of checkpoints.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// Timeout of an answer.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Retries while there is no trainer, since the session may be new. A request that may have arrived is not repeated: rolling back
/// is not idempotent.
const RETRY: Retry = Retry {
    delays: [Duration::from_millis(200); 2],
    patience: Duration::from_secs(5),
    when: |error| error.code == Code::Unavailable,
};

/// Queryables and announcements of the versions, which end when this is dropped.
#[derive(Debug)]
pub(crate) struct Publisher {
    _server: Server<Versions>,
    /// Tasks that end only with an error.
    pub(crate) tasks: JoinSet<anyhow::Result<()>>,
}

/// Starts announcing the promoted version of each model to all planners, present and future, and serving the versions; when
/// this returns, queries are answered.
///
/// # Errors
/// If zenoh refuses a declaration.
pub(crate) async fn start(session: &Session, versions: &Arc<Versions>) -> anyhow::Result<Publisher> {
    let mut server = Server::new(session, Arc::clone(versions));
    let places = || Places::new(PLACES);
    server.serve(key::checkpoint_chunk("*")?, &places(), Versions::chunk).await?;
    server.serve(key::checkpoint_list_versions("*")?, &places(), Versions::list).await?;
    let promote = key::checkpoint_promote("*")?;
    server.serve_change(promote, &places(), (CHANGES, "promote"), Versions::promote).await?;
    let roll_back = key::checkpoint_roll_back("*")?;
    server.serve_change(roll_back, &places(), (CHANGES, "roll_back"), Versions::roll_back).await?;

    let mut tasks = JoinSet::new();
    tasks.spawn(announce(session.clone(), Arc::clone(versions)));
    tasks.spawn(take_in(Arc::clone(versions)));
    Ok(Publisher { _server: server, tasks })
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
    let _planners = planners.callback(on_token).await.into_anyhow()?;

    let mut promoted = versions.promoted();
    loop {
        let announcements: Vec<_> = promoted.borrow_and_update().values().cloned().collect();
        for announcement in announcements {
            let CheckpointManifest { model, version, digest, .. } = &announcement.manifest;
            debug!(model, version, digest, "announced");
            let key = key::checkpoint_announcement(model)?;
            session.put(key, encode(announcement)).await.into_anyhow()?;
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

/// Calls a trainer.
async fn call<Q: Message + Clone, R: Message>(session: &Session, key: &OwnedKeyExpr, request: Q) -> Result<R, Error> {
    network::ask(session, key, request, TIMEOUT, RETRY).await
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
