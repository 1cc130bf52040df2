//! Training runs of the service: their registry, their processes, and the transports that start and watch them.
//!
//! [`client`] is the client side.

pub mod client;
pub(crate) mod grpc;
pub(crate) mod metrics;
mod process;
mod registry;
pub(crate) mod zenoh;

pub use registry::{Config, Runs};
