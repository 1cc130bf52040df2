//! Tests of the recordings.

#![expect(clippy::unwrap_used, reason = "tests")]

mod recording;
mod trial;
