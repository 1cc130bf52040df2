//! Tests of the trainer.

#![expect(clippy::unwrap_used, reason = "tests")]

mod changes;
mod common;
mod crash;
mod ingest;
mod metrics;
mod output;
mod positions;
mod publish;
mod recordings;
mod resume;
mod runs;
mod sampler;
mod swap;
mod train;
mod versions;
