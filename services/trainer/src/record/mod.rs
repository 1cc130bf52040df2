//! Recording of demonstration streams.
//!
//! Steps and commits come in over zenoh ([`start`]); episodes in progress are put together ([`ingest`]), checked step by step
//! ([`frame`]) and kept in a folder ([`folder`]). Recordings can be sent to another trainer ([`send`]), copied from one
//! ([`mirror`]) and checked ([`verify`]).

pub mod folder;
pub mod frame;
pub mod ingest;
pub mod mirror;
pub mod send;
pub mod verify;
mod zenoh;

pub use self::zenoh::{Recorder, start};
