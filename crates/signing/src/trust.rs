//! Policies towards checkpoints without a valid signature.

use serde::{Deserialize, Serialize};

/// Policy towards checkpoints without a valid signature by a trusted key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Trust {
    /// Signatures are not checked.
    Off,
    /// Unverified checkpoints are served, with a warning.
    Warn,
    /// Unverified checkpoints are refused.
    Enforce,
}
