//! Publishing checkpoints, from the trainer to planners.

use crate::message::{digest, name};
use crate::{Error, Message, proto};

/// Largest piece of a checkpoint in one reply: zenoh's batch size.
pub const MAX_CHUNK_BYTES: u32 = 65_536;

/// Tells planners of a new checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CheckpointAnnouncement {
    /// Name to serve the model under.
    pub model: String,
    /// SHA-256 of the checkpoint, in hex.
    pub digest: String,
    /// Its size.
    pub size_bytes: u64,
}

/// Asks for one piece of an announced checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CheckpointChunkRequest {
    /// Where the piece starts.
    pub offset_bytes: u64,
    /// How long it is.
    pub length_bytes: u32,
}

/// One piece of a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CheckpointChunkResponse {
    /// The bytes asked for.
    pub data: Vec<u8>,
}

impl Message for CheckpointAnnouncement {
    type Proto = proto::CheckpointAnnouncement;
}

impl TryFrom<proto::CheckpointAnnouncement> for CheckpointAnnouncement {
    type Error = Error;

    fn try_from(announcement: proto::CheckpointAnnouncement) -> Result<Self, Error> {
        Ok(Self {
            model: name("model", announcement.model)?,
            digest: digest("digest", announcement.digest)?,
            size_bytes: announcement.size_bytes,
        })
    }
}

impl From<CheckpointAnnouncement> for proto::CheckpointAnnouncement {
    fn from(announcement: CheckpointAnnouncement) -> Self {
        let CheckpointAnnouncement { model, digest, size_bytes } = announcement;
        Self { model, digest, size_bytes }
    }
}

impl Message for CheckpointChunkRequest {
    type Proto = proto::CheckpointChunkRequest;
}

impl TryFrom<proto::CheckpointChunkRequest> for CheckpointChunkRequest {
    type Error = Error;

    fn try_from(request: proto::CheckpointChunkRequest) -> Result<Self, Error> {
        let proto::CheckpointChunkRequest { offset_bytes, length_bytes } = request;
        if !(1..=MAX_CHUNK_BYTES).contains(&length_bytes) {
            return Err(Error::invalid("length_bytes", format!("1 to {MAX_CHUNK_BYTES}"), length_bytes));
        }
        Ok(Self { offset_bytes, length_bytes })
    }
}

impl From<CheckpointChunkRequest> for proto::CheckpointChunkRequest {
    fn from(request: CheckpointChunkRequest) -> Self {
        let CheckpointChunkRequest { offset_bytes, length_bytes } = request;
        Self { offset_bytes, length_bytes }
    }
}

impl Message for CheckpointChunkResponse {
    type Proto = proto::CheckpointChunkResponse;
}

impl TryFrom<proto::CheckpointChunkResponse> for CheckpointChunkResponse {
    type Error = Error;

    fn try_from(response: proto::CheckpointChunkResponse) -> Result<Self, Error> {
        Ok(Self { data: response.data })
    }
}

impl From<CheckpointChunkResponse> for proto::CheckpointChunkResponse {
    fn from(response: CheckpointChunkResponse) -> Self {
        Self { data: response.data }
    }
}
