//! Where positions become tensors.

use tch::Tensor;

/// Values of a position: x, y, z.
pub const SIZE: i64 = 3;

/// Stacks positions, in metres, into a `[B, 3]` tensor.
pub fn from_metres(positions: &[[f32; 3]]) -> Tensor {
    Tensor::from_slice(positions.as_flattened()).view([-1, SIZE])
}
