//! Recording of demonstration streams.
//!
//! Steps and commits arrive over zenoh ([`start`]); episodes in progress are assembled ([`ingest`]), checked step by step
//! ([`frame`]) and stored in a folder ([`folder`]). Recordings can be sent to another trainer ([`send`]), copied from one
//! ([`mirror`]) and verified ([`verify`]).

pub mod folder;
pub mod frame;
pub mod ingest;
pub mod mirror;
pub mod send;
pub mod verify;
mod zenoh;

pub use self::zenoh::{Recorder, start};
