//! Verification of signed checkpoints: bundles of OpenSSF Model Signing 1.0, checked against trusted public keys.
//!
//! A bundle is a JSON file beside the checkpoint. [`Bundle`] parses the format: a Sigstore bundle around a DSSE envelope
//! around an in-toto statement, which has the SHA-256 of one file. [`TrustedKeys`] verifies the signer. Bundles are made by the
//! format's own tools, never here.

mod bundle;
mod error;
mod keys;
mod trust;

pub use bundle::{Bundle, MAX_BYTES, digest};
pub use error::{Error, Fault};
pub use keys::{KeyError, TrustedKeys};
pub use trust::Trust;

/// File name extension of bundles, appended to the full name of the signed file.
pub const EXTENSION: &str = "sig";
