//! Named tensors and one JSON document in a safetensors file.

use crate::unique;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::{BTreeMap, HashMap};
use tch::Tensor;

/// The one metadata key; its value is a JSON document.
const METADATA_KEY: &str = "cpn";
/// Longest header that is read, in bytes: to parse one takes many times as much memory.
const MAX_HEADER_BYTES: u64 = 1 << 20;

/// Tensors by name, in the order they are written.
pub type Tensors = BTreeMap<String, Tensor>;

/// Serialises tensors with a document about them. The same contents give the same bytes.
///
/// # Errors
/// If the document has no JSON form or a tensor's kind has none in safetensors.
pub fn to_bytes<M: Serialize>(tensors: &Tensors, metadata: &M) -> Result<Vec<u8>, ArchiveError> {
    let json = serde_json::to_string(metadata).map_err(|e| ArchiveError(e.to_string()))?;
    let raw = tensors
        .iter()
        .map(|(name, tensor)| {
            let tensor = tensor.detach().contiguous();
            let mut data = vec![0; tensor.numel() * tensor.kind().elt_size_in_bytes()];
            tensor.f_copy_data_u8(&mut data, tensor.numel())?;
            let shape: Vec<usize> = tensor.size().iter().map(|&n| n as usize).collect();
            Ok((name, Dtype::try_from(tensor.kind())?, shape, data))
        })
        .collect::<Result<Vec<_>, tch::TchError>>()
        .map_err(|e| ArchiveError(e.to_string()))?;
    let views = raw
        .iter()
        .map(|(name, dtype, shape, data)| Ok((name.as_str(), TensorView::new(*dtype, shape.clone(), data)?)))
        .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
        .map_err(|e| ArchiveError(e.to_string()))?;
    safetensors::serialize(views, &Some(HashMap::from([(METADATA_KEY.to_owned(), json)])))
        .map_err(|e| ArchiveError(e.to_string()))
}

/// Reads what [`to_bytes`] wrote.
///
/// # Errors
/// If the file is truncated or malformed, its header is too long, or it lacks a valid document.
pub fn from_bytes<M: DeserializeOwned>(bytes: &[u8]) -> Result<(Tensors, M), ArchiveError> {
    let header_bytes = bytes.first_chunk().map_or(0, |length| u64::from_le_bytes(*length));
    if header_bytes > MAX_HEADER_BYTES {
        // Not how many: of a file that is none of these, that would be its first bytes.
        return Err(ArchiveError(format!("header: expected at most {MAX_HEADER_BYTES} bytes, got more")));
    }
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| ArchiveError(e.to_string()))?;
    let json = header
        .metadata()
        .as_ref()
        .and_then(|metadata| metadata.get(METADATA_KEY))
        .ok_or_else(|| ArchiveError(format!("metadata: expected the key \"{METADATA_KEY}\", got none")))?;
    // The library has found the header whole.
    let header = bytes.get(size_of::<u64>()..).and_then(|rest| rest.get(..header_bytes as usize)).unwrap_or_default();
    unique::check(header).map_err(|e| ArchiveError(format!("header: {e}")))?;
    unique::check(json.as_bytes()).map_err(|e| ArchiveError(format!("metadata: {e}")))?;
    let document = serde_json::from_str(json).map_err(|e| ArchiveError(format!("metadata: {e}")))?;
    let file = SafeTensors::deserialize(bytes).map_err(|e| ArchiveError(e.to_string()))?;
    let tensors = file
        .tensors()
        .into_iter()
        .map(|(name, view)| Ok((name, Tensor::try_from(view)?)))
        .collect::<Result<_, tch::TchError>>()
        .map_err(|e| ArchiveError(e.to_string()))?;
    Ok((tensors, document))
}

/// A safetensors file that cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[error("safetensors: {0}")]
pub struct ArchiveError(String);
