//! Signature policy: trusted keys, and the treatment of unverified checkpoints.

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

/// File name extension of checkpoints.
const CHECKPOINT: &str = "safetensors";

/// Trusted keys, and the policy towards checkpoints that none of them signed. A checkpoint is parsed only after it has passed.
#[derive(Debug)]
pub(crate) struct Signatures {
    trust: Trust,
    keys: TrustedKeys,
}

impl Signatures {
    /// Reads the trusted keys. Without a configured policy, it is `warn` if there are keys, else `off`.
    ///
    /// # Errors
    /// If a file of keys cannot be read or is malformed, or the policy is `warn` or `enforce` without any key.
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

    /// Verifies a file of the model folder by the bundle beside it. Blocks.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if the policy is `enforce` and no trusted key signed the file.
    pub(crate) fn check_file(&self, folder: &Path, name: &str, bytes: &[u8]) -> Result<(), Error> {
        self.apply_policy(name, || {
            // One byte beyond the limit, so that a larger bundle is refused as too large.
            let beside = format!("{name}.{}", signing::EXTENSION);
            let bundle = match files::read_inside(folder, &beside, signing::MAX_BYTES + 1) {
                Ok(bundle) => Some(bundle),
                Err(error) if error.kind() == ErrorKind::NotFound => None,
                Err(error) => return Err(unreadable(&error)),
            };
            self.keys.verify(bundle.as_deref(), name, bytes)
        })
    }

    /// Applies the policy to a checkpoint without a signature.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if the policy is `enforce`.
    pub(crate) fn check_unsigned(&self, model: &str) -> Result<(), Error> {
        let name = file_name(model);
        self.apply_policy(&name, || self.keys.verify(None, &name, &[]))
    }

    /// Verifies the signature of a published checkpoint by its manifest; the bytes are compared with the digest elsewhere.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if the policy is `enforce` and no trusted key signed the checkpoint.
    pub(crate) fn check_published(&self, manifest: &CheckpointManifest) -> Result<(), Error> {
        let name = file_name(&manifest.model);
        let bundle = manifest.signature_bundle.as_deref().map(str::as_bytes);
        self.apply_policy(&name, || self.keys.verify_digest(bundle, &name, &manifest.digest))
    }

    fn apply_policy<'a>(
        &self,
        file: &str,
        verify: impl FnOnce() -> Result<&'a str, signing::Error>,
    ) -> Result<(), Error> {
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

/// File name that signatures have for a model's checkpoint.
fn file_name(model: &str) -> String {
    format!("{model}.{CHECKPOINT}")
}

fn unreadable(error: &std::io::Error) -> signing::Error {
    signing::Error { fault: Fault::Malformed, expected: "a bundle that can be read".into(), got: error.to_string() }
}
