//! Recordings: one demonstrated episode in one MCAP file, which Foxglove, Rerun and every MCAP library can read.
//!
//! [`Episode`] is steps that fit together; [`to_bytes`] and [`from_bytes`] are the file. The messages are `RawImage` of
//! Foxglove's schemas at `/camera` and those of `proto/cpn/v1/demonstration.proto` beside it.

mod episode;
mod read;
mod schema;
mod write;

pub use episode::Episode;
pub use read::{ReadError, from_bytes, read, read_header};
pub use write::to_bytes;

/// How the names of recordings end.
pub const EXTENSION: &str = "mcap";
/// Largest recording that is read, in bytes, compressed or not: three times the longest episode of 84 x 84 frames.
pub const MAX_BYTES: usize = 64 << 20;
