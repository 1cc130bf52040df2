//! Follower of a trainer's announcements: verifies the signature, fetches the checkpoint, checks it, and swaps it in.

use crate::core::PlannerCore;
use service_kit::network::{self, Retry};
use std::collections::HashMap;
use std::time::Duration;
use wire::checkpoint::{
    CheckpointAnnouncement, CheckpointChunkRequest, CheckpointChunkResponse, CheckpointManifest, MAX_CHUNK_BYTES,
};
use wire::{Code, Error, key};
use zenoh::Session;

/// Timeout of the answer with one chunk of a checkpoint.
const CHUNK_TIMEOUT: Duration = Duration::from_secs(5);
/// Retries of chunk requests: right after a reconnect a query can end without an answer, and many planners may ask at once.
const RETRY: Retry = Retry {
    delays: [Duration::from_millis(200); 2],
    patience: Duration::from_secs(1),
    when: |error| matches!(error.code, Code::Unavailable | Code::ResourceExhausted),
};

/// Follower of checkpoint announcements, which serves them one after the other.
#[derive(Debug)]
pub(crate) struct Follower {
    session: Session,
    core: PlannerCore,
    /// Promotion time of the latest announcement served, by model.
    promoted_unix_nanos: HashMap<String, u64>,
}

impl Follower {
    pub(crate) fn new(session: Session, core: PlannerCore) -> Self {
        Self { session, core, promoted_unix_nanos: HashMap::new() }
    }

    /// Fetches and serves an announced checkpoint, unless an announcement as late or later was served before: announcements
    /// are repeated, and arrive in any order.
    ///
    /// # Errors
    /// If the message is malformed, or the checkpoint's signature is refused, or the checkpoint cannot be fetched, does not
    /// match its manifest, or is faulty.
    pub(crate) async fn follow(&mut self, message: &[u8]) -> Result<(), Error> {
        let CheckpointAnnouncement { manifest, promoted_unix_nanos } = wire::decode(message)?;
        let model = manifest.model.clone();
        if self.promoted_unix_nanos.get(&model).is_some_and(|latest| *latest >= promoted_unix_nanos) {
            return Ok(());
        }
        if !self.serves(&manifest) {
            let bytes = fetch(&self.session, &manifest);
            self.core.load_published(manifest.clone(), bytes).await?;
        }
        self.promoted_unix_nanos.insert(model, promoted_unix_nanos);
        Ok(())
    }

    fn serves(&self, CheckpointManifest { model, version, digest, .. }: &CheckpointManifest) -> bool {
        let served = self.core.list_models().models;
        served.iter().any(|info| (&info.name, &info.version, &info.digest) == (model, version, digest))
    }
}

/// Fetches the bytes of a manifest's checkpoint, in chunks; not verified.
async fn fetch(session: &Session, manifest: &CheckpointManifest) -> Result<Vec<u8>, Error> {
    let CheckpointManifest { digest, size_bytes, .. } = manifest;
    let size = usize::try_from(*size_bytes).unwrap_or(usize::MAX);
    if size > cpn::checkpoint::MAX_BYTES {
        let limit = format!("at most {}", cpn::checkpoint::MAX_BYTES);
        return Err(Error::invalid("size_bytes", limit, size_bytes));
    }

    let key = key::checkpoint_chunk(digest)?;
    let mut bytes = Vec::with_capacity(size);
    while bytes.len() < size {
        let length_bytes = u32::try_from(size - bytes.len()).unwrap_or(u32::MAX).min(MAX_CHUNK_BYTES);
        let offset_bytes = bytes.len() as u64;
        let request = CheckpointChunkRequest { digest: digest.clone(), offset_bytes, length_bytes };
        let CheckpointChunkResponse { data: chunk } =
            network::ask(session, &key, request, CHUNK_TIMEOUT, RETRY).await?;
        if chunk.len() != length_bytes as usize {
            return Err(Error::invalid("data", format!("{length_bytes} bytes"), format!("{} bytes", chunk.len())));
        }
        bytes.extend(chunk);
    }
    Ok(bytes)
}
