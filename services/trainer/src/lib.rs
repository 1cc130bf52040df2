//! Takes in demonstration streams, trains the learned methods, publishes checkpoints.
//!
//! Two processes that meet in the file system, so that neither can take the other down: the service ([`service`]) keeps
//! every committed episode ([`ingest`]) and offers every finished checkpoint to the planners ([`publish`]); a training
//! run ([`train`]) reads the episodes ([`dataset`]) and writes a checkpoint.

pub mod adam;
pub mod dataset;
pub mod episode;
pub mod ingest;
pub mod publish;
pub mod service;
pub mod train;
