//! Network protocol: protobuf messages, their native types, zenoh keys, and queries.
//!
//! Bytes are decoded into native types here and nowhere else: [`decode`] bounds the size, parses, and validates every
//! field, so that services see valid values only. A property test round-trips every message.

pub mod access;
mod approach;
pub mod checkpoint;
pub mod demonstration;
mod error;
pub mod grpc;
mod image;
pub mod key;
mod message;
mod observation;
pub mod planner;
pub mod query;
mod search;
pub mod sim;
pub mod trace;
pub mod training;
pub mod trial;

pub use error::{Code, Error};
pub use image::Image;
pub use message::{Message, decode, encode};
pub use observation::{Observation, Position};

/// The generated types of the Open Inference Protocol.
#[allow(missing_docs, clippy::all, reason = "generated code")]
pub mod inference {
    tonic::include_proto!("inference");
}

/// The generated protobuf types.
#[allow(missing_docs, clippy::all, reason = "generated code")]
pub mod proto {
    tonic::include_proto!("cpn.v1");

    /// Encoded `FileDescriptorSet` of all messages, for gRPC reflection and the schemas of recordings.
    pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
}
