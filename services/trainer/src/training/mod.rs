//! Training of a model: one process, from recordings to a checkpoint.
//!
//! A run ([`run`]) with its settings ([`config`]) reads the episodes ([`dataset`]), draws samples of them ([`sampler`],
//! [`augment`]) for its [`learner`] with its optimiser ([`adam`]), reports its [`progress`], keeps a [`journal`] with
//! TensorBoard events ([`tensorboard`]) and a learning curve, and writes a checkpoint.

pub mod adam;
pub mod allocator;
pub mod augment;
pub mod config;
mod curve;
pub mod dataset;
pub mod journal;
pub mod learner;
pub mod progress;
pub mod run;
pub mod sampler;
pub mod tensorboard;
