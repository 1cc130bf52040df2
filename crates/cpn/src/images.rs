//! Where image bytes become tensors.

use tch::{Kind, Tensor};

/// Width and height of every image, in pixels (section "Experiment design").
pub const SIZE: i64 = 84;
/// Colour channels: red, green, blue.
pub const CHANNELS: i64 = 3;
/// Bytes of one image.
pub const BYTES: usize = (SIZE * SIZE * CHANNELS) as usize;

/// Stacks RGB8 images into a `[B, 84, 84, 3]` tensor of bytes.
///
/// # Errors
/// If the bytes are not a whole, non-zero number of images.
pub fn from_bytes(data: &[u8]) -> Result<Tensor, ImageError> {
    if data.is_empty() || !data.len().is_multiple_of(BYTES) {
        return Err(ImageError { got: data.len() });
    }
    let shape = [(data.len() / BYTES) as i64, SIZE, SIZE, CHANNELS];
    Ok(Tensor::from_data_size(data, &shape, Kind::Uint8))
}

/// Image data of the wrong length.
#[derive(Debug, thiserror::Error)]
#[error("image data: expected a multiple of {BYTES} bytes ({SIZE} x {SIZE} RGB8), got {got}")]
pub struct ImageError {
    /// Length that came, in bytes.
    pub got: usize,
}
