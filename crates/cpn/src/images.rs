//! Sizes of images.

/// Width and height of every image, in pixels (section "Experiment design").
pub const SIZE: i64 = 84;
/// Colour channels: red, green, blue.
pub const CHANNELS: i64 = 3;
/// Bytes of one image, RGB8, row by row.
pub const BYTES: usize = (SIZE * SIZE * CHANNELS) as usize;
