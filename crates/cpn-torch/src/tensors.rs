//! Conversion between plain numbers and tensors of libtorch.

use cpn::archive;
use cpn::method::{Frames, Observed};
use cpn::{images, positions, steps_left};
use tch::{Device, Kind, Tensor};

/// Images as `[B, 84, 84, 3]` bytes.
///
/// # Panics
/// If the bytes are not a whole, non-zero number of images.
pub fn from_images(bytes: &[u8]) -> Tensor {
    let count = bytes.len() / images::BYTES;
    assert!(count > 0 && bytes.len() == count * images::BYTES, "whole images, and at least one");
    Tensor::from_data_size(bytes, &[count as i64, images::SIZE, images::SIZE, images::CHANNELS], Kind::Uint8)
}

/// Positions, in metres, as `[B, 3]`.
pub fn from_positions(metres: &[[f32; 3]]) -> Tensor {
    Tensor::from_slice(metres.as_flattened()).view([-1, positions::SIZE])
}

/// Frames as one tensor.
///
/// # Panics
/// If the bytes are not a whole, non-zero number of images.
pub fn from_frames(frames: &Frames) -> Tensor {
    match frames {
        Frames::Images(bytes) => from_images(bytes),
        Frames::Positions(metres) => from_positions(metres),
    }
}

/// Observations of one kind as one tensor.
///
/// # Panics
/// If there are none, or they are of different kinds.
pub fn from_observed(inputs: &[Observed<'_>]) -> Tensor {
    let frames = match inputs[0] {
        Observed::Image(_) => Frames::Images(inputs.iter().flat_map(image).copied().collect()),
        Observed::Position(_) => Frames::Positions(inputs.iter().map(position).collect()),
    };
    from_frames(&frames)
}

fn image<'a>(input: &Observed<'a>) -> &'a [u8] {
    match input {
        Observed::Image(bytes) => bytes,
        Observed::Position(_) => panic!("expected an image, got a position"),
    }
}

fn position(input: &Observed<'_>) -> [f32; 3] {
    match input {
        Observed::Position(metres) => *metres,
        Observed::Image(_) => panic!("expected a position, got an image"),
    }
}

/// Indices as `[B]` integers.
pub fn from_indices(indices: &[usize]) -> Tensor {
    Tensor::from_slice(&indices.iter().map(|index| *index as i64).collect::<Vec<_>>())
}

/// Numbers of steps left, scaled, as `[B]`.
pub fn from_steps_left(steps: impl Iterator<Item = u32>) -> Tensor {
    Tensor::from_slice(&steps.map(steps_left::scaled).collect::<Vec<_>>())
}

/// A tensor of an archive, with its element type.
///
/// # Panics
/// If the type is not float32, float64, int64 or uint8.
pub fn from_archive(tensor: &archive::Tensor) -> Tensor {
    let shape: Vec<i64> = tensor.shape().iter().map(|size| *size as i64).collect();
    let elements = tensor.elements::<f32>().map(|elements| Tensor::from_slice(&elements));
    let elements = elements.or_else(|| tensor.elements::<f64>().map(|elements| Tensor::from_slice(&elements)));
    let elements = elements.or_else(|| tensor.elements::<i64>().map(|elements| Tensor::from_slice(&elements)));
    let elements = elements.or_else(|| tensor.elements::<u8>().map(|elements| Tensor::from_slice(&elements)));
    elements.expect("numbers of 32 or 64 bits, or bytes").view(&shape[..])
}

/// A tensor for an archive, as float32.
pub fn to_archive(tensor: &Tensor) -> archive::Tensor {
    let shape: Vec<usize> = tensor.size().iter().map(|size| *size as usize).collect();
    archive::Tensor::new(&shape, &to_floats(tensor))
}

/// A tensor's elements in row-major order, as float32.
pub fn to_floats(tensor: &Tensor) -> Vec<f32> {
    let tensor = tensor.detach().to_device(Device::Cpu).to_kind(Kind::Float).flatten(0, -1).contiguous();
    Vec::try_from(tensor).expect("float32, in one row")
}
