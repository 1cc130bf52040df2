//! Sizes of positions.

/// Values of a position: x, y, z, in metres.
pub const SIZE: i64 = 3;
