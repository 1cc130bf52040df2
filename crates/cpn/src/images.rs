//! Shape of images.

/// Width and height of an image, in pixels (section "Experiment design").
pub const SIZE: i64 = 84;
/// Colour channels: red, green, blue.
pub const CHANNELS: i64 = 3;
/// Size of an image, RGB8 in row-major order, in bytes.
pub const BYTES: usize = (SIZE * SIZE * CHANNELS) as usize;
