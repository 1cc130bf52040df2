//! Tests of the planner.

#![expect(clippy::unwrap_used, reason = "tests")]

mod changes;
mod common;
mod config;
mod contract;
mod examples;
mod kserve;
mod lifecycle;
mod malformed;
mod metrics;
mod network;
mod openpi;
mod queue;
mod search;
mod secure;
mod signatures;
mod soak;
mod swap;
mod trace;
