//! Recordings: one episode per MCAP file, readable by Foxglove, Rerun and every MCAP library.
//!
//! [`Episode`] is a validated demonstration; [`to_bytes`] and [`from_bytes`] encode and decode its file. The messages are
//! Foxglove's `RawImage` at `/camera`, and those of `proto/cpn/v1/demonstration.proto`. [`trial`] has recordings of
//! trials: frames, plan requests and responses, with the messages of `proto/cpn/v1/{trial,planner}.proto`.

mod camera;
mod episode;
mod file;
mod read;
mod records;
mod topic;
pub mod trial;
mod write;

pub use episode::Episode;
pub use file::ReadError;
pub use read::{from_bytes, read, read_header};
pub use write::to_bytes;

/// File name extension of recordings.
pub const EXTENSION: &str = "mcap";
/// Largest recording, in bytes, compressed or not: three times the longest episode of 84 x 84 frames.
pub const MAX_BYTES: usize = 64 << 20;
