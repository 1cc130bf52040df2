//! Publishing of checkpoints: numbered versions of each model, offered to planners over zenoh.
//!
//! Versions are stored in a folder ([`versions`]) with a history of promotions, each with the signature beside its checkpoint.

mod history;
mod signature;
pub mod versions;
mod zenoh;

pub(crate) use self::zenoh::{Publisher, start};
pub use self::zenoh::{list, promote, roll_back, table};
