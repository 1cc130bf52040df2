//! What every service needs around its work: configuration, files, logs, metrics, shutdown, gRPC, a zenoh session.

pub mod config;
pub mod files;
pub mod grpc;
pub mod metrics;
pub mod session;
pub mod shutdown;
pub mod telemetry;

pub use grpc::GrpcServer;
pub use session::SessionConfig;
