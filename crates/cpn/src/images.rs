//! Where image bytes become tensors.

use tch::{Kind, Tensor};

/// Width and height of every image, in pixels (section "Experiment design").
pub const SIZE: i64 = 84;
/// Colour channels: red, green, blue.
pub const CHANNELS: i64 = 3;
/// Width and height of the blocks that [`blocks_in_bfloat16`] cuts images into, in pixels: the first stride of the paper's encoder.
pub const BLOCK: i64 = 4;
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

/// Images `[B, 84, 84, 3]` as bfloat16, cut into blocks of [`BLOCK`] x [`BLOCK`] pixels that lie one after the other:
/// `[B, 21, 21, 4, 4, 3]`.
pub fn blocks_in_bfloat16(images: &Tensor) -> Tensor {
    const RUN: usize = (BLOCK * CHANNELS) as usize;
    let (side, size) = ((SIZE / BLOCK) as usize, BLOCK as usize);
    let mut bytes = vec![0; images.numel()];
    images.copy_data_u8(&mut bytes, images.numel());
    let mut blocks: Vec<u16> = Vec::with_capacity(bytes.len());
    // A band of four rows of pixels holds a row of blocks.
    for band in bytes.as_chunks::<RUN>().0.chunks_exact(side * size) {
        for block in 0..side {
            for row in 0..size {
                // 8 bits fit a bfloat16, which is the upper half of a float32.
                blocks.extend(band[row * side + block].map(|value| (f32::from(value).to_bits() >> 16) as u16));
            }
        }
    }
    let shape = [images.size()[0], SIZE / BLOCK, SIZE / BLOCK, BLOCK, BLOCK, CHANNELS];
    Tensor::from_data_size(bytemuck::cast_slice::<u16, u8>(&blocks), &shape, Kind::BFloat16)
}

/// Image data of the wrong length.
#[derive(Debug, thiserror::Error)]
#[error("image data: expected a multiple of {BYTES} bytes ({SIZE} x {SIZE} RGB8), got {got}")]
pub struct ImageError {
    /// Length that came, in bytes.
    pub got: usize,
}
