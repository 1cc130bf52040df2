//! Checkpoint publishing, from the trainer to planners.

use crate::message::{digest, name, required};
use crate::{Error, Message, proto};
use serde::{Deserialize, Serialize};

/// Largest piece of a checkpoint in one reply: zenoh's batch size.
pub const MAX_CHUNK_BYTES: u32 = 65_536;
/// Largest signature bundle, in bytes.
pub const MAX_SIGNATURE_BUNDLE_BYTES: usize = 65_536;
/// Most parents of a checkpoint.
const MAX_PARENTS: usize = 64;

/// Manifest of a published checkpoint; stored as JSON beside the weights.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CheckpointManifest {
    /// Name to serve the model under.
    pub model: String,
    /// Version number within the name, from 1.
    pub version: u32,
    /// SHA-256 of the checkpoint, in hex.
    pub digest: String,
    /// Size of the checkpoint, in bytes.
    pub size_bytes: u64,
    /// SHA-256 of the model's configuration, in hex.
    pub config_digest: String,
    /// SHA-256 of the checkpoints that it was derived from, in hex.
    pub parents: Vec<String>,
    /// Signature of the checkpoint, a bundle of OpenSSF Model Signing in JSON; not verified.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub signature_bundle: Option<String>,
}

/// Announcement of the version of a model that planners should serve.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CheckpointAnnouncement {
    /// Manifest of the promoted checkpoint.
    pub manifest: CheckpointManifest,
    /// Time of the promotion, in nanoseconds since the Unix epoch; the latest announcement wins.
    pub promoted_unix_nanos: u64,
}

/// Request for a byte range of a published checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CheckpointChunkRequest {
    /// SHA-256 of the checkpoint, in hex.
    pub digest: String,
    /// Offset of the range, in bytes.
    pub offset_bytes: u64,
    /// Length of the range, in bytes.
    pub length_bytes: u32,
}

/// Byte range of a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CheckpointChunkResponse {
    /// Bytes of the range.
    pub data: Vec<u8>,
}

/// Request for the stored versions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListVersionsRequest {
    /// Name of one model; all models if none.
    pub model: Option<String>,
}

/// Stored versions.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListVersionsResponse {
    /// Versions, ordered by model and number.
    pub versions: Vec<CheckpointVersion>,
}

/// Stored version of a model.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct CheckpointVersion {
    /// Manifest of the version.
    #[serde(flatten)]
    pub manifest: CheckpointManifest,
    /// Whether planners are told to serve this version.
    pub promoted: bool,
}

/// Request that planners serve a stored version.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PromoteVersionRequest {
    /// Name of the model.
    pub model: String,
    /// Version to serve.
    pub version: u32,
}

/// Version that is now promoted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PromoteVersionResponse {
    /// Manifest of the version.
    pub manifest: CheckpointManifest,
}

/// Request that planners serve the previously promoted version.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RollBackRequest {
    /// Name of the model.
    pub model: String,
}

/// Version that is now promoted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RollBackResponse {
    /// Manifest of the version.
    pub manifest: CheckpointManifest,
}

impl Message for CheckpointManifest {
    type Proto = proto::CheckpointManifest;
}

impl TryFrom<proto::CheckpointManifest> for CheckpointManifest {
    type Error = Error;

    fn try_from(manifest: proto::CheckpointManifest) -> Result<Self, Error> {
        let proto::CheckpointManifest {
            model,
            version: number,
            digest: sha256,
            size_bytes,
            config_digest,
            parents,
            signature_bundle,
        } = manifest;

        if parents.len() > MAX_PARENTS {
            return Err(Error::invalid("parents", format!("at most {MAX_PARENTS}"), parents.len()));
        }
        if signature_bundle.len() > MAX_SIGNATURE_BUNDLE_BYTES {
            let (expected, got) = (format!("at most {MAX_SIGNATURE_BUNDLE_BYTES} bytes"), signature_bundle.len());
            return Err(Error::invalid("signature_bundle", expected, format!("{got} bytes")));
        }

        Ok(Self {
            model: name("model", model)?,
            version: version(number)?,
            digest: digest("digest", sha256)?,
            size_bytes,
            config_digest: digest("config_digest", config_digest)?,
            parents: parents.into_iter().map(|parent| digest("parents", parent)).collect::<Result<_, _>>()?,
            signature_bundle: Some(signature_bundle).filter(|bundle| !bundle.is_empty()),
        })
    }
}

impl From<CheckpointManifest> for proto::CheckpointManifest {
    fn from(manifest: CheckpointManifest) -> Self {
        let CheckpointManifest { model, version, digest, size_bytes, config_digest, parents, signature_bundle } =
            manifest;
        let signature_bundle = signature_bundle.unwrap_or_default();
        Self { model, version, digest, size_bytes, config_digest, parents, signature_bundle }
    }
}

impl Message for CheckpointAnnouncement {
    type Proto = proto::CheckpointAnnouncement;
}

impl TryFrom<proto::CheckpointAnnouncement> for CheckpointAnnouncement {
    type Error = Error;

    fn try_from(announcement: proto::CheckpointAnnouncement) -> Result<Self, Error> {
        let proto::CheckpointAnnouncement { manifest, promoted_unix_nanos } = announcement;
        Ok(Self { manifest: required("manifest", manifest)?, promoted_unix_nanos })
    }
}

impl From<CheckpointAnnouncement> for proto::CheckpointAnnouncement {
    fn from(announcement: CheckpointAnnouncement) -> Self {
        let CheckpointAnnouncement { manifest, promoted_unix_nanos } = announcement;
        Self { manifest: Some(manifest.into()), promoted_unix_nanos }
    }
}

impl Message for CheckpointChunkRequest {
    type Proto = proto::CheckpointChunkRequest;
}

impl TryFrom<proto::CheckpointChunkRequest> for CheckpointChunkRequest {
    type Error = Error;

    fn try_from(request: proto::CheckpointChunkRequest) -> Result<Self, Error> {
        let proto::CheckpointChunkRequest { digest: sha256, offset_bytes, length_bytes } = request;
        if !(1..=MAX_CHUNK_BYTES).contains(&length_bytes) {
            return Err(Error::invalid("length_bytes", format!("1 to {MAX_CHUNK_BYTES}"), length_bytes));
        }
        Ok(Self { digest: digest("digest", sha256)?, offset_bytes, length_bytes })
    }
}

impl From<CheckpointChunkRequest> for proto::CheckpointChunkRequest {
    fn from(request: CheckpointChunkRequest) -> Self {
        let CheckpointChunkRequest { digest, offset_bytes, length_bytes } = request;
        Self { digest, offset_bytes, length_bytes }
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

impl Message for ListVersionsRequest {
    type Proto = proto::ListVersionsRequest;
}

impl TryFrom<proto::ListVersionsRequest> for ListVersionsRequest {
    type Error = Error;

    fn try_from(request: proto::ListVersionsRequest) -> Result<Self, Error> {
        let model = Some(request.model).filter(|model| !model.is_empty());
        Ok(Self { model: model.map(|model| name("model", model)).transpose()? })
    }
}

impl From<ListVersionsRequest> for proto::ListVersionsRequest {
    fn from(request: ListVersionsRequest) -> Self {
        Self { model: request.model.unwrap_or_default() }
    }
}

impl Message for ListVersionsResponse {
    type Proto = proto::ListVersionsResponse;
    /// Larger than the default: every version may carry a signature bundle.
    const MAX_BYTES: usize = 16 << 20;
}

impl TryFrom<proto::ListVersionsResponse> for ListVersionsResponse {
    type Error = Error;

    fn try_from(response: proto::ListVersionsResponse) -> Result<Self, Error> {
        let versions = response.versions.into_iter().map(CheckpointVersion::try_from).collect::<Result<_, _>>();
        Ok(Self { versions: versions.map_err(|e| e.within("versions"))? })
    }
}

impl From<ListVersionsResponse> for proto::ListVersionsResponse {
    fn from(response: ListVersionsResponse) -> Self {
        Self { versions: response.versions.into_iter().map(Into::into).collect() }
    }
}

impl TryFrom<proto::CheckpointVersion> for CheckpointVersion {
    type Error = Error;

    fn try_from(version: proto::CheckpointVersion) -> Result<Self, Error> {
        Ok(Self { manifest: required("manifest", version.manifest)?, promoted: version.promoted })
    }
}

impl From<CheckpointVersion> for proto::CheckpointVersion {
    fn from(version: CheckpointVersion) -> Self {
        Self { manifest: Some(version.manifest.into()), promoted: version.promoted }
    }
}

impl Message for PromoteVersionRequest {
    type Proto = proto::PromoteVersionRequest;
}

impl TryFrom<proto::PromoteVersionRequest> for PromoteVersionRequest {
    type Error = Error;

    fn try_from(request: proto::PromoteVersionRequest) -> Result<Self, Error> {
        Ok(Self { model: name("model", request.model)?, version: version(request.version)? })
    }
}

impl From<PromoteVersionRequest> for proto::PromoteVersionRequest {
    fn from(request: PromoteVersionRequest) -> Self {
        Self { model: request.model, version: request.version }
    }
}

impl Message for PromoteVersionResponse {
    type Proto = proto::PromoteVersionResponse;
}

impl TryFrom<proto::PromoteVersionResponse> for PromoteVersionResponse {
    type Error = Error;

    fn try_from(response: proto::PromoteVersionResponse) -> Result<Self, Error> {
        Ok(Self { manifest: required("manifest", response.manifest)? })
    }
}

impl From<PromoteVersionResponse> for proto::PromoteVersionResponse {
    fn from(response: PromoteVersionResponse) -> Self {
        Self { manifest: Some(response.manifest.into()) }
    }
}

impl Message for RollBackRequest {
    type Proto = proto::RollBackRequest;
}

impl TryFrom<proto::RollBackRequest> for RollBackRequest {
    type Error = Error;

    fn try_from(request: proto::RollBackRequest) -> Result<Self, Error> {
        Ok(Self { model: name("model", request.model)? })
    }
}

impl From<RollBackRequest> for proto::RollBackRequest {
    fn from(request: RollBackRequest) -> Self {
        Self { model: request.model }
    }
}

impl Message for RollBackResponse {
    type Proto = proto::RollBackResponse;
}

impl TryFrom<proto::RollBackResponse> for RollBackResponse {
    type Error = Error;

    fn try_from(response: proto::RollBackResponse) -> Result<Self, Error> {
        Ok(Self { manifest: required("manifest", response.manifest)? })
    }
}

impl From<RollBackResponse> for proto::RollBackResponse {
    fn from(response: RollBackResponse) -> Self {
        Self { manifest: Some(response.manifest.into()) }
    }
}

/// Validates a version number: 1 or more.
fn version(number: u32) -> Result<u32, Error> {
    if number == 0 { Err(Error::invalid("version", "1 or more", number)) } else { Ok(number) }
}
