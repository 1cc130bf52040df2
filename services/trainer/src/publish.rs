//! Offers finished checkpoints to planners: an announcement names a digest, the bytes are fetched piece by piece.

use anyhow::{Context, anyhow};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, SystemTime};
use tracing::{info, warn};
use wire::checkpoint::{CheckpointAnnouncement, CheckpointChunkRequest, CheckpointChunkResponse};
use wire::{Code, Error, encode, key, query};
use zenoh::Session;
use zenoh::sample::SampleKind;

/// How often the folder is looked at.
const POLL_INTERVAL: Duration = Duration::from_secs(1);

/// A checkpoint on offer.
#[derive(Debug)]
struct Offer {
    announcement: CheckpointAnnouncement,
    modified: SystemTime,
    bytes: Arc<Vec<u8>>,
}

/// The checkpoints of a folder, by model name, which is the stem of the file's name.
#[derive(Debug)]
struct Offers {
    folder: PathBuf,
    by_model: Mutex<HashMap<String, Offer>>,
}

impl Offers {
    /// Reads new and changed files; answers what to announce.
    fn refresh(&self) -> anyhow::Result<Vec<CheckpointAnnouncement>> {
        let mut news = Vec::new();
        for entry in std::fs::read_dir(&self.folder).with_context(|| self.folder.display().to_string())? {
            let path = entry?.path();
            let Some(model) = model_name(&path) else { continue };
            let modified = std::fs::metadata(&path)?.modified()?;
            let mut by_model = self.by_model.lock().unwrap_or_else(PoisonError::into_inner);
            if by_model.get(&model).is_some_and(|offer| offer.modified == modified) {
                continue;
            }
            let bytes = std::fs::read(&path)?;
            let announcement = CheckpointAnnouncement {
                model: model.clone(),
                digest: cpn::checkpoint::digest(&bytes),
                size_bytes: bytes.len() as u64,
            };
            news.push(announcement.clone());
            by_model.insert(model, Offer { announcement, modified, bytes: Arc::new(bytes) });
        }
        Ok(news)
    }

    fn announcements(&self) -> Vec<CheckpointAnnouncement> {
        let by_model = self.by_model.lock().unwrap_or_else(PoisonError::into_inner);
        by_model.values().map(|offer| offer.announcement.clone()).collect()
    }

    /// The piece of the checkpoint whose digest stands in the query's key.
    fn chunk(
        &self,
        digest: Option<String>,
        request: &CheckpointChunkRequest,
    ) -> Result<CheckpointChunkResponse, Error> {
        let by_model = self.by_model.lock().unwrap_or_else(PoisonError::into_inner);
        let digest = digest.unwrap_or_default();
        let offer = by_model.values().find(|offer| offer.announcement.digest == digest).ok_or_else(|| {
            let on_offer: Vec<_> = by_model.values().map(|offer| offer.announcement.digest.as_str()).collect();
            Error::new(Code::NotFound, "digest", format!("one of {on_offer:?}"), &digest)
        })?;
        let size = offer.bytes.len();
        let start = usize::try_from(request.offset_bytes)
            .ok()
            .filter(|start| *start < size)
            .ok_or_else(|| Error::invalid("offset_bytes", format!("less than {size}"), request.offset_bytes))?;
        let end = size.min(start + request.length_bytes as usize);
        Ok(CheckpointChunkResponse { data: offer.bytes[start..end].to_vec() })
    }
}

/// `cpn` for `cpn.safetensors`; none for any other file.
fn model_name(path: &Path) -> Option<String> {
    (path.extension()? == "safetensors").then(|| path.file_stem()?.to_str().map(str::to_owned))?
}

/// Announces every checkpoint of `folder` to every planner, those to come included, and serves their bytes, until the
/// session closes.
///
/// # Errors
/// If the folder cannot be read or zenoh refuses a declaration.
pub async fn serve(session: &Session, folder: PathBuf) -> anyhow::Result<()> {
    std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    let offers = Offers { folder, by_model: Mutex::default() };
    let zenoh = |e: zenoh::Error| anyhow!(e);
    let chunks = session.declare_queryable(key::checkpoint_chunk("*")?).complete(true).await.map_err(zenoh)?;
    let planners =
        session.liveliness().declare_subscriber(key::planner_alive("*")?).history(true).await.map_err(zenoh)?;
    let mut poll = tokio::time::interval(POLL_INTERVAL);
    loop {
        let news = tokio::select! {
            Ok(query) = chunks.recv_async() => {
                let digest = key::digest_of_checkpoint_chunk(query.key_expr());
                let answer = query::request(&query).and_then(|request| offers.chunk(digest, &request));
                if let Err(error) = query::reply(&query, answer) {
                    warn!(%error, "chunk not sent");
                }
                continue;
            }
            Ok(token) = planners.recv_async() => match token.kind() {
                SampleKind::Put => offers.announcements(),
                SampleKind::Delete => continue,
            },
            _ = poll.tick() => offers.refresh().unwrap_or_else(|error| {
                warn!(error = format!("{error:#}"), "checkpoint folder not read");
                Vec::new()
            }),
            else => return Ok(()),
        };
        for announcement in news {
            info!(model = announcement.model, digest = announcement.digest, "announced");
            let key = key::checkpoint_announcement(&announcement.model)?;
            session.put(key, encode(announcement)).await.map_err(zenoh)?;
        }
    }
}
