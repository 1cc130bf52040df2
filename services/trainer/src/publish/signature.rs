//! Signatures beside checkpoints, which are passed on unverified: the trusted keys are a setting of planners.

use service_kit::files;
use signing::Bundle;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use tracing::warn;

/// Path of the signature of a checkpoint's file.
pub(crate) fn path(checkpoint: &Path) -> PathBuf {
    let mut path = checkpoint.as_os_str().to_owned();
    path.push(".");
    path.push(signing::EXTENSION);
    path.into()
}

/// Bundle beside a checkpoint, if it claims these bytes. Another one, for example of the previous weights, is ignored with a
/// warning.
pub(crate) fn beside(checkpoint: &Path, bytes: &[u8]) -> Option<String> {
    let path = path(checkpoint);
    let passed_over = |error: &dyn std::fmt::Display| {
        warn!(path = %path.display(), %error, "signature passed over");
        None
    };

    // One byte beyond the limit, so that a larger bundle is refused as too large.
    let bundle = match files::read_at_most(&path, signing::MAX_BYTES + 1) {
        Ok(bundle) => bundle,
        Err(error) if error.kind() == ErrorKind::NotFound => return None,
        Err(error) => return passed_over(&error),
    };
    match Bundle::parse(&bundle).and_then(|bundle| bundle.claimed_digest()) {
        Err(error) => return passed_over(&error),
        Ok(claimed) if claimed != signing::digest(bytes) => {
            return passed_over(&format!("it is that of {claimed}"));
        }
        Ok(_) => {}
    }
    String::from_utf8(bundle).map_or_else(|error| passed_over(&error), Some)
}
