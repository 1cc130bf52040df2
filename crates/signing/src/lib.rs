//! Verification of signed checkpoints: bundles of OpenSSF Model Signing 1.0, checked against trusted public keys.
//!
//! A bundle is a JSON file that lies beside the checkpoint. [`bundle`](Bundle) reads the format: a Sigstore bundle around a
//! DSSE envelope around an in-toto statement, which names the SHA-256 of one file. [`TrustedKeys`] checks who signed it. Bundles
//! are made by the format's own tools, never here.

mod bundle;
mod error;
mod keys;
mod trust;

pub use bundle::{Bundle, MAX_BYTES, digest};
pub use error::{Error, Fault};
pub use keys::{KeyError, TrustedKeys};
pub use trust::Trust;

/// End of a bundle's file name, after the whole name of the file that it signs.
pub const EXTENSION: &str = "sig";
