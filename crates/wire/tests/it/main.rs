//! Tests of the messages.

#![expect(clippy::unwrap_used, reason = "tests")]

mod digest;
mod keys;
mod malformed;
mod round_trip;
