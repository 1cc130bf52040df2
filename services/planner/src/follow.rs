//! Follows what a trainer announces: checks its signature, fetches, verifies, tries, swaps.

use crate::core::PlannerCore;
use backon::{ConstantBuilder, Retryable};
use std::collections::HashMap;
use std::time::Duration;
use wire::checkpoint::{
    CheckpointAnnouncement, CheckpointChunkRequest, CheckpointChunkResponse, CheckpointManifest, MAX_CHUNK_BYTES,
};
use wire::{Code, Error, key, query};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;

/// How long one piece of a checkpoint may take.
const CHUNK_TIMEOUT: Duration = Duration::from_secs(5);

/// Serves what is announced, one after the other.
#[derive(Debug)]
pub(crate) struct Follower {
    session: Session,
    core: PlannerCore,
    /// When the announced checkpoint that was swapped in last was promoted, by model.
    promoted_unix_nanos: HashMap<String, u64>,
}

impl Follower {
    pub(crate) fn new(session: Session, core: PlannerCore) -> Self {
        Self { session, core, promoted_unix_nanos: HashMap::new() }
    }

    /// Fetches and serves what a message announces, unless a later announcement was heeded already: they are repeated, and
    /// may come in any order.
    ///
    /// # Errors
    /// If the message is malformed, the checkpoint's signature is refused, it cannot be fetched or is not what its manifest
    /// says, or it is faulty.
    pub(crate) async fn follow(&mut self, message: &[u8]) -> Result<(), Error> {
        let CheckpointAnnouncement { manifest, promoted_unix_nanos } = wire::decode(message)?;
        let model = manifest.model.clone();
        if self.promoted_unix_nanos.get(&model).is_some_and(|heeded| *heeded >= promoted_unix_nanos) {
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

/// The bytes that a manifest names, piece by piece; not verified yet.
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
        let chunk = fetch_chunk(session, &key, &request).await?;
        if chunk.len() != length_bytes as usize {
            return Err(Error::invalid("data", format!("{length_bytes} bytes"), format!("{} bytes", chunk.len())));
        }
        bytes.extend(chunk);
    }
    Ok(bytes)
}

/// When to ask for a piece again: right after a reconnect a query can end without an answer, and many planners may ask at once.
fn again() -> ConstantBuilder {
    ConstantBuilder::default().with_delay(Duration::from_millis(200)).with_max_times(4)
}

async fn fetch_chunk(
    session: &Session,
    key: &OwnedKeyExpr,
    request: &CheckpointChunkRequest,
) -> Result<Vec<u8>, Error> {
    let ask = || query::call(session, key, request.clone(), CHUNK_TIMEOUT);
    let answer: CheckpointChunkResponse = ask
        .retry(again())
        .when(|error: &Error| matches!(error.code, Code::Unavailable | Code::ResourceExhausted))
        .await?;
    Ok(answer.data)
}
