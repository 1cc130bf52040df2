//! Errors of signature verification.

use std::fmt;

/// Longest quotation of a bundle in an error, in bytes.
const MAX_TEXT_BYTES: usize = 200;

/// Missing or invalid signature of a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("signature: expected {expected}, got {got}")]
pub struct Error {
    /// Kind of fault.
    pub fault: Fault,
    /// Description of a valid value.
    pub expected: String,
    /// The value that came.
    pub got: String,
}

/// Kinds of faults of a signature.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// No bundle.
    Unsigned,
    /// Bundle of another format, or damaged.
    Malformed,
    /// Signature by no trusted key.
    Untrusted,
    /// Signature of another file by a trusted key.
    Mismatch,
}

impl Fault {
    /// Name in logs and metrics.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unsigned => "unsigned",
            Self::Malformed => "malformed",
            Self::Untrusted => "untrusted",
            Self::Mismatch => "mismatch",
        }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Error {
    /// Error with overlong texts truncated.
    pub(crate) fn new(fault: Fault, expected: impl ToString, got: impl ToString) -> Self {
        let cut = |mut text: String| {
            if text.len() > MAX_TEXT_BYTES {
                text.truncate(text.floor_char_boundary(MAX_TEXT_BYTES));
                text.push('…');
            }
            text
        };
        Self { fault, expected: cut(expected.to_string()), got: cut(got.to_string()) }
    }

    pub(crate) fn malformed(expected: impl ToString, got: impl ToString) -> Self {
        Self::new(Fault::Malformed, expected, got)
    }
}
