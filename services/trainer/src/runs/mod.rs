//! Training runs of the service: their registry, their processes, and the transports by which they are started and watched.
//!
//! [`client`] is the other side.

pub mod client;
pub(crate) mod grpc;
pub(crate) mod metrics;
mod process;
mod registry;
pub(crate) mod zenoh;

pub use registry::{Config, Runs};
