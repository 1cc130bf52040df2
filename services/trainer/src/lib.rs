//! Takes in demonstration streams, trains the learned methods, publishes checkpoints.
//!
//! Processes that meet in the file system, so that none can take another down: the service ([`service`]) keeps every
//! committed episode ([`record`]), offers the versions of every model to the planners ([`publish`]), and starts and watches
//! training runs ([`runs`]); a run ([`training`]) reads the episodes and writes a checkpoint.

pub mod publish;
mod queries;
pub mod record;
pub mod runs;
pub mod service;
pub mod training;
