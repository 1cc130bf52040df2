//! Takes in demonstration streams, trains the learned methods, publishes checkpoints.
//!
//! Two processes that meet in the file system, so that neither can take the other down: the service ([`service`]) keeps
//! every committed episode ([`ingest`], [`recorder`]) and offers every finished checkpoint to the planners
//! ([`publish`]); a training run ([`train`]) reads the episodes, as pictures ([`dataset`]) or as positions
//! ([`positions`]), tells how far it is ([`progress`]) and writes a checkpoint. Recordings ([`recordings`]) can be sent again ([`replay`]), copied from another recorder ([`mirror`]), and checked ([`verify`]).

pub mod adam;
pub mod dataset;
pub mod episode;
pub mod ingest;
pub mod mirror;
pub mod positions;
pub mod progress;
pub mod publish;
pub mod recorder;
pub mod recordings;
pub mod replay;
pub mod service;
pub mod train;
pub mod verify;
