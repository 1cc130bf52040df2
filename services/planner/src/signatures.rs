//! What becomes of checkpoints that no trusted key signed.

use crate::config::Config;
use anyhow::{Context, ensure};
use metrics::counter;
use service_kit::files;
use signing::{Fault, Trust, TrustedKeys};
use std::io::ErrorKind;
use std::path::Path;
use tracing::{debug, warn};
use wire::checkpoint::CheckpointManifest;
use wire::{Code, Error};

/// End of a checkpoint's file name.
const CHECKPOINT: &str = "safetensors";

/// The trusted keys, and the policy towards checkpoints that none of them signed. Nothing else of a checkpoint is looked at
/// before it has passed here.
#[derive(Debug)]
pub(crate) struct Signatures {
    trust: Trust,
    keys: TrustedKeys,
}

impl Signatures {
    /// Reads the keys that are trusted. If there are any and nothing is said of trust, it is `warn`.
    ///
    /// # Errors
    /// If a file of keys cannot be read, or there is no key where one is needed.
    pub(crate) fn new(config: &Config) -> anyhow::Result<Self> {
        let mut keys = TrustedKeys::default();
        for path in &config.trusted_keys {
            let read = || anyhow::Ok(TrustedKeys::from_pem(&std::fs::read_to_string(path)?)?);
            keys.extend(read().with_context(|| format!("trusted_keys: {}", path.display()))?);
        }
        let trust = config.trust.unwrap_or(if keys.is_empty() { Trust::Off } else { Trust::Warn });
        ensure!(
            trust == Trust::Off || !keys.is_empty(),
            "trusted_keys: expected a key or more, as trust is on, got none"
        );
        Ok(Self { trust, keys })
    }

    /// Checks a file of the models folder by the bundle beside it. Blocks.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if no trusted key signed it and that is refused.
    pub(crate) fn check_file(&self, folder: &Path, name: &str, bytes: &[u8]) -> Result<(), Error> {
        self.judge(name, || {
            // One byte more than a bundle may have, so that it is refused as too large.
            let beside = format!("{name}.{}", signing::EXTENSION);
            let bundle = match files::read_inside(folder, &beside, signing::MAX_BYTES + 1) {
                Ok(bundle) => Some(bundle),
                Err(error) if error.kind() == ErrorKind::NotFound => None,
                Err(error) => return Err(unreadable(&error)),
            };
            self.keys.verify(bundle.as_deref(), name, bytes)
        })
    }

    /// Checks a checkpoint that came with no signature.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if that is refused.
    pub(crate) fn check_unsigned(&self, model: &str) -> Result<(), Error> {
        let name = file_name(model);
        self.judge(&name, || self.keys.verify(None, &name, &[]))
    }

    /// Checks a published checkpoint by its manifest; that the bytes are of the manifest's digest is not checked here.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if no trusted key signed it and that is refused.
    pub(crate) fn check_published(&self, manifest: &CheckpointManifest) -> Result<(), Error> {
        let name = file_name(&manifest.model);
        let bundle = manifest.signature_bundle.as_deref().map(str::as_bytes);
        self.judge(&name, || self.keys.verify_digest(bundle, &name, &manifest.digest))
    }

    fn judge<'a>(&self, file: &str, verify: impl FnOnce() -> Result<&'a str, signing::Error>) -> Result<(), Error> {
        if self.trust == Trust::Off {
            return Ok(());
        }
        let error = match verify() {
            Ok(key) => {
                debug!(file, key, "signed by a trusted key");
                return Ok(());
            }
            Err(error) => error,
        };

        let reason = error.fault.name();
        if self.trust == Trust::Warn {
            counter!("cpn_planner_checkpoints_unverified_total", "reason" => reason).increment(1);
            warn!(file, reason, %error, "checkpoint accepted though no trusted key signed it");
            return Ok(());
        }
        counter!("cpn_planner_checkpoints_refused_total", "reason" => reason).increment(1);
        warn!(file, reason, %error, "checkpoint refused: no trusted key signed it");
        Err(Error::new(Code::FailedPrecondition, "signature", error.expected, error.got))
    }
}

/// Name of a model's checkpoint, where it has no file.
fn file_name(model: &str) -> String {
    format!("{model}.{CHECKPOINT}")
}

fn unreadable(error: &std::io::Error) -> signing::Error {
    signing::Error { fault: Fault::Malformed, expected: "a bundle that can be read".into(), got: error.to_string() }
}
