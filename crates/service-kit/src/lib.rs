//! Infrastructure shared by all services: configuration, files, logs, metrics, output, shutdown, a zenoh session with
//! queryables, requests and names, and listeners with TLS and access control for gRPC and others.

pub mod access;
pub mod changes;
pub mod config;
pub mod files;
pub mod grpc;
pub mod listener;
pub mod metrics;
pub mod network;
pub mod output;
pub mod process;
pub mod session;
pub mod shutdown;
pub mod telemetry;
pub mod tls;

pub use grpc::GrpcServer;
pub use session::SessionConfig;
