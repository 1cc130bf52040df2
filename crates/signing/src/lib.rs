//! Verification of signed checkpoints.
