//! Tests of certificates and access.

#![expect(clippy::unwrap_used, reason = "tests")]

mod access;
mod common;
mod refusals;
