//! Takes in demonstration streams, trains the learned methods, publishes checkpoints.
//!
//! Processes that meet in the file system, so that none can take another down: the service ([`service`]) keeps every
//! committed episode ([`ingest`], [`recorder`]), keeps the [`versions`] of every model and offers them to the planners
//! ([`publish`]), and starts and watches training runs ([`runs`], by `grpc` and `runs_zenoh`; [`client`] is the other side).
//!
//! A run ([`train`]) reads the episodes ([`dataset`]), draws samples of them ([`sampler`], [`augment`]) for its [`learner`],
//! tells how far it is ([`progress`], [`journal`]) and writes a checkpoint. Recordings ([`recordings`]) can be sent again
//! ([`replay`]), copied from another recorder ([`mirror`]), and checked ([`verify`]).

pub mod adam;
pub mod augment;
pub mod client;
pub mod config;
mod curve;
pub mod dataset;
pub mod frame;
mod grpc;
mod history;
pub mod ingest;
pub mod journal;
pub mod learner;
pub mod memory;
pub mod mirror;
pub mod progress;
pub mod publish;
mod queries;
pub mod recorder;
pub mod recordings;
pub mod replay;
mod run_process;
pub mod runs;
mod runs_metrics;
mod runs_zenoh;
pub mod sampler;
pub mod service;
mod signature;
pub mod tensorboard;
pub mod train;
pub mod verify;
pub mod versions;
