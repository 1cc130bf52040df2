//! Training of a model in one process, from recordings to a checkpoint.
//!
//! A run ([`run`]) with its settings ([`config`]) reads the episodes ([`dataset`]), draws batches ([`sampler`], [`augment`]) for
//! the [`Learner`](cpn::Learner) of its engine, reports its [`progress`], writes a [`journal`] with TensorBoard events
//! ([`tensorboard`]) and a learning curve, and at the end a checkpoint.

pub mod allocator;
pub mod augment;
pub mod config;
mod curve;
pub mod dataset;
pub mod journal;
pub mod progress;
pub mod run;
pub mod sampler;
pub mod tensorboard;
