//! Archives: safetensors files of named tensors and one JSON document.

use crate::unique;
use bytemuck::Pod;
use safetensors::tensor::TensorView;
use safetensors::{SafeTensorError, SafeTensors};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::{BTreeMap, HashMap};

pub use safetensors::Dtype;

/// The one metadata key; its value is a JSON document.
const METADATA_KEY: &str = "cpn";
/// Maximum length of a header, in bytes: parsing it takes many times as much memory.
const MAX_HEADER_BYTES: u64 = 1 << 20;

/// Tensors by name, in the order of the file.
pub type Tensors = BTreeMap<String, Tensor>;

/// A tensor: type of its elements, shape, and elements in row-major order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tensor {
    dtype: Dtype,
    shape: Vec<usize>,
    /// Elements in native byte order, which on supported machines is safetensors' little endian.
    bytes: Vec<u8>,
}

/// Element type of a tensor.
pub trait Scalar: Pod {
    /// The type's name in safetensors.
    const DTYPE: Dtype;
}

impl Scalar for f32 {
    const DTYPE: Dtype = Dtype::F32;
}

impl Scalar for f64 {
    const DTYPE: Dtype = Dtype::F64;
}

impl Scalar for i64 {
    const DTYPE: Dtype = Dtype::I64;
}

impl Scalar for u8 {
    const DTYPE: Dtype = Dtype::U8;
}

impl Tensor {
    /// A tensor of `elements` in row-major order.
    ///
    /// # Panics
    /// If the number of elements differs from the product of the shape.
    pub fn new<T: Scalar>(shape: &[usize], elements: &[T]) -> Self {
        assert_eq!(shape.iter().product::<usize>(), elements.len(), "elements of a tensor of shape {shape:?}");
        Self { dtype: T::DTYPE, shape: shape.to_vec(), bytes: bytemuck::cast_slice(elements).to_vec() }
    }

    /// Type of the elements.
    pub fn dtype(&self) -> Dtype {
        self.dtype
    }

    /// The shape; empty for a scalar.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The elements in row-major order; `None` if they are of another type.
    pub fn elements<T: Scalar>(&self) -> Option<Vec<T>> {
        (self.dtype == T::DTYPE).then(|| bytemuck::pod_collect_to_vec(&self.bytes))
    }
}

/// Serialises tensors and a document. Equal contents give equal bytes.
///
/// # Errors
/// If the document cannot be represented as JSON.
pub fn to_bytes<M: Serialize>(tensors: &Tensors, metadata: &M) -> Result<Vec<u8>, ArchiveError> {
    let json = serde_json::to_string(metadata).map_err(|e| ArchiveError(e.to_string()))?;
    let views = tensors
        .iter()
        .map(|(name, Tensor { dtype, shape, bytes })| {
            Ok((name.as_str(), TensorView::new(*dtype, shape.clone(), bytes)?))
        })
        .collect::<Result<Vec<_>, SafeTensorError>>()?;
    Ok(safetensors::serialize(views, Some(HashMap::from([(METADATA_KEY.to_owned(), json)])))?)
}

/// Deserialises the bytes of [`to_bytes`].
///
/// # Errors
/// If the file is truncated or malformed, its header is too long, or it lacks a valid document.
pub fn from_bytes<M: DeserializeOwned>(bytes: &[u8]) -> Result<(Tensors, M), ArchiveError> {
    let header_bytes = bytes.first_chunk().map_or(0, |length| u64::from_le_bytes(*length));
    if header_bytes > MAX_HEADER_BYTES {
        // Without the length: in a file of another format it is an arbitrary number.
        return Err(ArchiveError(format!("header: expected at most {MAX_HEADER_BYTES} bytes, got more")));
    }

    let (_, header) = SafeTensors::read_metadata(bytes)?;
    let json = header
        .metadata()
        .as_ref()
        .and_then(|metadata| metadata.get(METADATA_KEY))
        .ok_or_else(|| ArchiveError(format!("metadata: expected the key \"{METADATA_KEY}\", got none")))?;

    // `read_metadata` has checked that the header is complete.
    let header = bytes.get(size_of::<u64>()..).and_then(|rest| rest.get(..header_bytes as usize)).unwrap_or_default();
    unique::check(header).map_err(|e| ArchiveError(format!("header: {e}")))?;
    unique::check(json.as_bytes()).map_err(|e| ArchiveError(format!("metadata: {e}")))?;

    let document = serde_json::from_str(json).map_err(|e| ArchiveError(format!("metadata: {e}")))?;
    let file = SafeTensors::deserialize(bytes)?;
    let tensor = |view: &TensorView<'_>| Tensor {
        dtype: view.dtype(),
        shape: view.shape().to_vec(),
        bytes: view.data().to_vec(),
    };
    Ok((file.iter().map(|(name, view)| (name.to_owned(), tensor(&view))).collect(), document))
}

/// A safetensors file that cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[error("safetensors: {0}")]
pub struct ArchiveError(String);

impl From<SafeTensorError> for ArchiveError {
    fn from(error: SafeTensorError) -> Self {
        Self(error.to_string())
    }
}
