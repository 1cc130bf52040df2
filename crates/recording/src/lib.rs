//! Recordings: one episode in one MCAP file, which Foxglove, Rerun and every MCAP library can read.
//!
//! [`Episode`] is a demonstration, steps that fit together; [`to_bytes`] and [`from_bytes`] are the file. The messages are
//! `RawImage` of Foxglove's schemas at `/camera` and those of `proto/cpn/v1/demonstration.proto` beside it. [`plans`] are
//! what a planner was asked in an episode and what it answered, as `proto/cpn/v1/replay.proto` says.

mod episode;
mod file;
pub mod plans;
mod read;
mod records;
mod topic;
mod write;

pub use episode::Episode;
pub use file::ReadError;
pub use read::{from_bytes, read, read_header};
pub use write::to_bytes;

/// How the names of recordings end.
pub const EXTENSION: &str = "mcap";
/// Largest recording that is read, in bytes, compressed or not: three times the longest episode of 84 x 84 frames.
pub const MAX_BYTES: usize = 64 << 20;
