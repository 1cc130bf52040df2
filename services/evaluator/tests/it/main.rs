//! Tests of the evaluator.

#![expect(clippy::unwrap_used, reason = "tests")]

mod closed_loop;
mod common;
mod compare;
mod outages;
mod replay;
mod report;
