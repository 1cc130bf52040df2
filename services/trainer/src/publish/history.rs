//! Version history of one model, in a folder with `history.json` and the weights of each version, named by their digest. A
//! version exists once the history lists it; unlisted weights are left over from a killed process or a removed version.

use anyhow::{Context, ensure};
use serde::{Deserialize, Serialize};
use service_kit::files;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};
use tracing::warn;
use wire::checkpoint::{CheckpointAnnouncement, CheckpointManifest};
use wire::{Code, Error};

/// File name extension of checkpoints.
const EXTENSION: &str = "safetensors";
/// Name of the history file.
const HISTORY: &str = "history.json";

/// Version history of one model.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct History {
    /// Manifests of the versions, oldest first.
    versions: Vec<CheckpointManifest>,
    /// Versions in the order of their latest promotions; the last one is promoted now.
    promotions: Vec<u32>,
    /// Time of the latest promotion, in nanoseconds since the Unix epoch; strictly increasing, even if the clock is set back.
    promoted_unix_nanos: u64,
}

impl History {
    /// Reads a model's history, without versions whose weights are missing or damaged, and removes files of no version; none if
    /// no version is left.
    ///
    /// # Errors
    /// If the history cannot be read, is malformed, or is that of another model.
    pub(crate) fn read(folder: &Path) -> anyhow::Result<Option<Self>> {
        files::remove_unfinished(folder)?;
        let mut history = match std::fs::read(folder.join(HISTORY)) {
            Err(e) if e.kind() == ErrorKind::NotFound => Self::default(),
            json => serde_json::from_slice(&json?).context(HISTORY)?,
        };
        let expected = folder.file_name().and_then(|name| name.to_str()).context("a folder with a name")?;
        for CheckpointManifest { model, .. } in &history.versions {
            ensure!(model == expected, "model: expected {expected:?}, got {model:?}");
        }

        for manifest in std::mem::take(&mut history.versions) {
            let manifest = valid(manifest)?;
            let got = digest(&weights(folder, &manifest.digest))?;
            if got.as_ref() == Some(&manifest.digest) {
                history.versions.push(manifest);
            } else {
                let CheckpointManifest { model, version, digest, .. } = manifest;
                warn!(
                    model,
                    version,
                    expected = digest,
                    ?got,
                    "version passed over: its weights are not what they were"
                );
            }
        }

        let before = history.promotions.last().copied();
        history.forget_lost_promotions();
        let last = history.versions.last().map(|manifest| manifest.version);
        match history.promotions.last().copied().or(last) {
            Some(promoted) if before != Some(promoted) => history.promote(promoted),
            _ => {}
        }

        history.remove_unused(folder);
        Ok((!history.versions.is_empty()).then_some(history))
    }

    /// Writes the history, atomically and durably; then removes weights of no version.
    ///
    /// # Errors
    /// If the history cannot be written.
    pub(crate) fn write(&self, folder: &Path) -> anyhow::Result<()> {
        files::write_atomically(&folder.join(HISTORY), &serde_json::to_vec_pretty(self)?)?;
        self.remove_unused(folder);
        Ok(())
    }

    /// Manifests of the versions, oldest first.
    pub(crate) fn manifests(&self) -> &[CheckpointManifest] {
        &self.versions
    }

    /// Promoted version.
    ///
    /// # Errors
    /// If there is none.
    pub(crate) fn promoted(&self) -> Result<&CheckpointManifest, Error> {
        let promoted = self.promotions.last();
        let manifest = self.versions.iter().find(|manifest| Some(&manifest.version) == promoted);
        manifest.ok_or_else(|| Error::new(Code::Internal, "promotions", "a version", "none"))
    }

    /// Announcement of the promoted version.
    ///
    /// # Errors
    /// If no version is promoted.
    pub(crate) fn announcement(&self) -> Result<CheckpointAnnouncement, Error> {
        let manifest = self.promoted()?.clone();
        Ok(CheckpointAnnouncement { manifest, promoted_unix_nanos: self.promoted_unix_nanos })
    }

    /// Adds and promotes a version, and removes all but the last `keep`.
    pub(crate) fn add(&mut self, manifest: CheckpointManifest, keep: usize) {
        self.promote(manifest.version);
        self.versions.push(manifest);
        self.versions.drain(..self.versions.len().saturating_sub(keep));
        self.forget_lost_promotions();
    }

    /// Adds a signature to all versions with these weights; false if they have it already.
    pub(crate) fn sign(&mut self, digest: &str, bundle: &str) -> bool {
        let mut changed = false;
        for manifest in self.versions.iter_mut().filter(|manifest| manifest.digest == digest) {
            if manifest.signature_bundle.as_deref() != Some(bundle) {
                manifest.signature_bundle = Some(bundle.to_owned());
                changed = true;
            }
        }
        changed
    }

    /// Promotes the previously promoted version; false if there is none.
    pub(crate) fn roll_back(&mut self) -> bool {
        self.promotions.pop();
        let before = self.promotions.last().copied();
        before.map(|before| self.promote(before)).is_some()
    }

    /// Promotes a version.
    pub(crate) fn promote(&mut self, version: u32) {
        self.promotions.retain(|promoted| *promoted != version);
        self.promotions.push(version);
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
        let now = u64::try_from(now).unwrap_or(u64::MAX);
        self.promoted_unix_nanos = now.max(self.promoted_unix_nanos.saturating_add(1));
    }

    fn forget_lost_promotions(&mut self) {
        let versions = &self.versions;
        self.promotions.retain(|promoted| versions.iter().any(|manifest| manifest.version == *promoted));
    }

    /// Removes weights of no version; an error is only logged.
    fn remove_unused(&self, folder: &Path) {
        let remove = || {
            for path in files::list(folder)? {
                let digest = stem(&path);
                if digest.is_some_and(|digest| self.versions.iter().all(|manifest| manifest.digest != digest)) {
                    std::fs::remove_file(path)?;
                }
            }
            anyhow::Ok(())
        };
        if let Err(error) = remove() {
            warn!(error = format!("{error:#}"), "old weights not removed");
        }
    }
}

/// Model name of a checkpoint's file, for example `cpn` of `cpn.safetensors`; none for other files.
pub(crate) fn stem(path: &Path) -> Option<String> {
    (path.extension()? == EXTENSION).then(|| path.file_stem()?.to_str().map(str::to_owned))?
}

/// Path of the weights of a digest.
pub(crate) fn weights(folder: &Path, digest: &str) -> PathBuf {
    folder.join(format!("{digest}.{EXTENSION}"))
}

/// Whether a checkpoint's file exists and has this digest.
pub(crate) fn is_whole(path: &Path, expected: &str) -> bool {
    digest(path).is_ok_and(|got| got.as_deref() == Some(expected))
}

/// Digest of a checkpoint's file; none if the file does not exist.
fn digest(path: &Path) -> anyhow::Result<Option<String>> {
    match files::read_at_most(path, cpn::checkpoint::MAX_BYTES) {
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(None),
        bytes => Ok(Some(cpn::checkpoint::digest(&bytes.with_context(|| path.display().to_string())?))),
    }
}

/// Validates a manifest by encoding and decoding it, which applies the rules of messages.
pub(crate) fn valid(manifest: CheckpointManifest) -> Result<CheckpointManifest, Error> {
    wire::decode(&wire::encode(manifest))
}
