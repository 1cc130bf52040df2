//! Policies towards checkpoints without a good signature.

use serde::{Deserialize, Serialize};

/// Policy towards checkpoints without a good signature.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Trust {
    /// Signatures are not looked at.
    Off,
    /// Such a checkpoint is served, with a warning.
    Warn,
    /// Such a checkpoint is refused.
    Enforce,
}
