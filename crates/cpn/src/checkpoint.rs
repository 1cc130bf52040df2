//! Checkpoints: safetensors files of weights, with the model's configuration and provenance in the metadata.

use crate::archive::{self, ArchiveError, Tensors};
use crate::config::{ConfigError, ModelConfig};
use crate::familiar::FamiliarGoals;
use crate::model::{self, Model, Parameter};
use crate::recipe::Training;
use crate::unique;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest, Sha256};

/// Maximum size of a checkpoint, in bytes.
pub const MAX_BYTES: usize = 64 << 20;
/// Version of the metadata; other versions are refused.
const FORMAT: u32 = 3;

/// Provenance of a model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// Tasks of the training episodes.
    pub training_tasks: Vec<String>,
    /// SHA-256 over the digests of the training episodes, in hex.
    pub data_digest: String,
    /// Render spec of the training frames, as the simulator's JSON; empty if unknown.
    pub render_spec: String,
    /// Seed of initialisation and sampling.
    pub seed: u64,
    /// Training settings.
    pub training: Training,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Metadata {
    format: u32,
    model: ModelConfig,
    provenance: Provenance,
}

/// A checkpoint that was read: a model with its provenance and digests.
#[derive(Debug)]
pub struct Checkpoint {
    /// Configuration, weights and familiar goals.
    pub model: Model,
    /// Provenance of the model.
    pub provenance: Provenance,
    /// SHA-256 of the checkpoint's bytes, in hex.
    pub digest: String,
    /// SHA-256 of the configuration's JSON in the metadata, in hex.
    pub config_digest: String,
}

impl Checkpoint {
    /// Digests of the model's inputs: that of the demonstrations, if it is known.
    pub fn parents(&self) -> Vec<String> {
        Some(self.provenance.data_digest.clone()).filter(|digest| !digest.is_empty()).into_iter().collect()
    }
}

/// Serialises a model. Equal contents give equal bytes.
///
/// # Errors
/// If the metadata cannot be represented as JSON, or the weights as safetensors.
pub fn to_bytes(model: &Model, provenance: &Provenance) -> Result<Vec<u8>, ArchiveError> {
    let metadata = Metadata { format: FORMAT, model: model.config.clone(), provenance: provenance.clone() };
    let mut tensors = model.weights.clone();
    tensors.extend(model.familiar.iter().flat_map(FamiliarGoals::tensors));
    archive::to_bytes(&tensors, &metadata)
}

/// Reads and validates a checkpoint; the bytes need not be trusted.
///
/// # Errors
/// If the size, the format or the configuration is invalid, or a tensor is missing, unknown, of the wrong shape or type, or not
/// finite.
pub fn from_bytes(bytes: &[u8]) -> Result<Checkpoint, CheckpointError> {
    if bytes.len() > MAX_BYTES {
        return Err(CheckpointError::TooLarge { got: bytes.len() });
    }

    // The version first: metadata of other versions have other fields.
    let (mut tensors, document): (_, Value) = archive::from_bytes(bytes)?;
    if document["format"] != FORMAT {
        let got = document["format"].as_u64().map_or_else(|| "no number".to_owned(), |format| format.to_string());
        return Err(CheckpointError::Format { got });
    }

    let metadata: Metadata = serde_json::from_value(document).map_err(CheckpointError::Metadata)?;
    metadata.model.validate()?;
    let render_spec = &metadata.provenance.render_spec;
    if !render_spec.is_empty() {
        unique::check(render_spec.as_bytes()).map_err(CheckpointError::RenderSpec)?;
    }

    let config = serde_json::to_vec(&metadata.model).map_err(CheckpointError::Metadata)?;
    check_tensors(&tensors, &metadata.model)?;
    let familiar = FamiliarGoals::take(&mut tensors);
    let model = Model { config: metadata.model, weights: tensors, familiar };
    let (digest, config_digest) = (digest(bytes), digest(&config));
    Ok(Checkpoint { model, provenance: metadata.provenance, digest, config_digest })
}

/// SHA-256 of bytes, in hex: the identity of a checkpoint.
pub fn digest(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

/// Checks that tensors are the weights and the familiar goals of a valid configuration, exactly in name, shape and type, and finite.
fn check_tensors(tensors: &Tensors, config: &ModelConfig) -> Result<(), CheckpointError> {
    let weights = model::parameters(config).into_iter().map(|Parameter { name, shape, .. }| (name, shape));
    let expected: Vec<_> = weights.chain(FamiliarGoals::shapes(config)).collect();
    let is_known = |name: &String| expected.iter().any(|(known, _)| known == name);
    if let Some(name) = tensors.keys().find(|name| !is_known(name)) {
        return Err(CheckpointError::UnknownTensor { name: name.clone() });
    }

    for (name, shape) in expected {
        let Some(tensor) = tensors.get(&name) else { return Err(CheckpointError::MissingTensor { name }) };
        match tensor.elements::<f32>().filter(|_| tensor.shape() == shape) {
            Some(elements) if elements.iter().all(|element| element.is_finite()) => {}
            Some(_) => return Err(CheckpointError::NotFinite { name }),
            None => {
                let (expected, got) = (format!("F32{shape:?}"), format!("{:?}{:?}", tensor.dtype(), tensor.shape()));
                return Err(CheckpointError::Shape { name, expected, got });
            }
        }
    }
    Ok(())
}

/// Fault of a refused checkpoint.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// More bytes than [`MAX_BYTES`].
    #[error("checkpoint: expected at most {MAX_BYTES} bytes, got {got}")]
    TooLarge {
        /// Size of the checkpoint, in bytes.
        got: usize,
    },
    /// A malformed archive.
    #[error("checkpoint: {0}")]
    Unreadable(#[from] ArchiveError),
    /// Another version of the metadata.
    #[error("checkpoint format: expected {FORMAT}, got {got}")]
    Format {
        /// Format in the file.
        got: String,
    },
    /// Metadata with a missing, unknown or invalid field.
    #[error("checkpoint metadata: {0}")]
    Metadata(serde_json::Error),
    /// A render spec that is not JSON.
    #[error("checkpoint provenance.render_spec: expected nothing or JSON, got {0}")]
    RenderSpec(serde_json::Error),
    /// A configuration out of range.
    #[error("checkpoint model: {0}")]
    Config(#[from] ConfigError),
    /// A tensor of the configuration that is missing in the file.
    #[error("checkpoint tensor \"{name}\": expected by the model's configuration, got none")]
    MissingTensor {
        /// The tensor's name.
        name: String,
    },
    /// A tensor in the file that is not part of the configuration.
    #[error("checkpoint tensor \"{name}\": not part of the model's configuration")]
    UnknownTensor {
        /// The tensor's name.
        name: String,
    },
    /// A tensor of another shape or type.
    #[error("checkpoint tensor \"{name}\": expected {expected}, got {got}")]
    Shape {
        /// The tensor's name.
        name: String,
        /// Type and shape by the configuration.
        expected: String,
        /// Type and shape in the file.
        got: String,
    },
    /// A tensor with NaN or infinity.
    #[error("checkpoint tensor \"{name}\": expected finite values, got NaN or infinity")]
    NotFinite {
        /// The tensor's name.
        name: String,
    },
}
