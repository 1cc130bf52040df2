//! Trainer: records demonstration streams, trains the learned methods, publishes checkpoints.
//!
//! Service and training runs are separate processes that share only files, so that none can take another down. The service
//! ([`service`]) stores committed episodes ([`record`]), publishes model versions to planners ([`publish`]), and starts and
//! watches training runs ([`runs`]); a run ([`training`]) reads the episodes and writes a checkpoint.

pub mod publish;
pub mod record;
pub mod runs;
pub mod service;
pub mod training;
