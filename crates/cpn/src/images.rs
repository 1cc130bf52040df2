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

/// Images `[B, 84, 84, 3]` as bfloat16, cut into blocks of `size` x `size` pixels that lie one after the other:
/// `[B, 84 / size, 84 / size, size, size, 3]`. `size` must divide 84.
pub fn blocks(images: &Tensor, size: usize) -> Tensor {
    let mut bytes = vec![0; images.numel()];
    images.copy_data_u8(&mut bytes, images.numel());
    // 8 bits fit a bfloat16, which is the upper half of a float32.
    let halves: Vec<u16> = bytes.iter().map(|value| (f32::from(*value).to_bits() >> 16) as u16).collect();
    let run = size * CHANNELS as usize;
    let mut blocks = Vec::with_capacity(halves.len());
    // A band of `size` rows holds a row of blocks.
    for band in halves.chunks_exact(run * SIZE as usize) {
        for block in 0..SIZE as usize / size {
            for row in band.chunks_exact((SIZE * CHANNELS) as usize) {
                blocks.extend_from_slice(&row[block * run..][..run]);
            }
        }
    }
    let (side, size) = (SIZE / size as i64, size as i64);
    let shape = [images.size()[0], side, side, size, size, CHANNELS];
    Tensor::from_data_size(bytemuck::cast_slice::<u16, u8>(&blocks), &shape, Kind::BFloat16)
}

/// Image data of the wrong length.
#[derive(Debug, thiserror::Error)]
#[error("image data: expected a multiple of {BYTES} bytes ({SIZE} x {SIZE} RGB8), got {got}")]
pub struct ImageError {
    /// Length that came, in bytes.
    pub got: usize,
}
