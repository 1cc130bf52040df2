//! Tests of the foundation of the services, and of the directions of dependencies.

#![expect(clippy::unwrap_used, reason = "tests")]

mod architecture;
mod limits;
