//! Zenoh shell of the services: typed queryables, requests with retries, and liveliness tokens of names.

mod alive;
mod ask;
mod serve;

pub use alive::{Name, claim};
pub use ask::{Retry, ask, is_outage};
pub use serve::{Places, Reply, Server};
