//! Shape of positions.

/// Number of coordinates of a position: x, y, z, in metres.
pub const SIZE: i64 = 3;
