//! What every service needs around its work: configuration, files, logs, shutdown, a zenoh session.

pub mod config;
pub mod files;
pub mod session;
pub mod shutdown;
pub mod telemetry;

pub use session::SessionConfig;
