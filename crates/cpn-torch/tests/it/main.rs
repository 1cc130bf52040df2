//! Tests of the engines against the reference by autograd.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;
mod golden;
mod gradients;
mod learner;
mod loss;
mod method;
mod planner;
