//! Published versions of all models, in the folder that training runs write their checkpoints to.
//!
//! `<model>.safetensors` is the latest checkpoint of a run, `<model>.safetensors.sig` its optional signature, and
//! `versions/<model>` the model's history.

use crate::publish::history::{self, History};
use crate::publish::signature;
use anyhow::Context;
use service_kit::files;
use std::collections::{BTreeMap, HashMap};
use std::fs::{File, Metadata};
use std::num::NonZeroU16;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use tokio::sync::watch;
use tracing::{info, warn};
use wire::checkpoint::{
    CheckpointAnnouncement, CheckpointChunkRequest, CheckpointChunkResponse, CheckpointManifest, CheckpointVersion,
    ListVersionsRequest, ListVersionsResponse, PromoteVersionRequest, PromoteVersionResponse, RollBackRequest,
    RollBackResponse,
};
use wire::{Code, Error};

/// Name of the folder of versions.
const VERSIONS: &str = "versions";

/// Published versions of all models, locked against other processes. All methods may block.
#[derive(Debug)]
pub struct Versions {
    /// Folder that training runs write to.
    checkpoints: PathBuf,
    keep: usize,
    /// Lock of the folder.
    _lock: File,
    /// Histories by model, each with at least one version. Locked until a change is durable.
    histories: Mutex<BTreeMap<String, History>>,
    /// Stamps of the latest checkpoint and signature published or refused, by model.
    seen: Mutex<HashMap<String, (Stamp, Option<Stamp>)>>,
    promoted: watch::Sender<BTreeMap<String, CheckpointAnnouncement>>,
}

/// Stamp that changes with every write to a file: inode, and change time in seconds and nanoseconds.
type Stamp = (u64, i64, i64);

fn stamp(metadata: &Metadata) -> Stamp {
    (metadata.ino(), metadata.ctime(), metadata.ctime_nsec())
}

impl Versions {
    /// Opens and locks a folder, created if there is none; of each model the last `keep` versions are kept.
    ///
    /// # Errors
    /// If the folder cannot be created or read, another process has it, or a history in it is malformed.
    pub fn open(checkpoints: PathBuf, keep: NonZeroU16) -> anyhow::Result<Self> {
        let folder = checkpoints.join(VERSIONS);
        let lock = files::take_over(&folder)?;
        let mut histories = BTreeMap::new();
        for folder in files::list(&folder)? {
            if folder.is_dir()
                && let Some(history) = History::read(&folder).with_context(|| folder.display().to_string())?
            {
                histories.insert(history.promoted()?.model.clone(), history);
            }
        }

        let promoted = histories.iter().map(|(model, history)| Ok((model.clone(), history.announcement()?)));
        let promoted = watch::Sender::new(promoted.collect::<Result<_, Error>>()?);
        let (histories, seen) = (Mutex::new(histories), Mutex::default());
        Ok(Self { checkpoints, keep: keep.get().into(), _lock: lock, histories, seen, promoted })
    }

    /// Announcements of the promoted versions, by model.
    pub fn promoted(&self) -> watch::Receiver<BTreeMap<String, CheckpointAnnouncement>> {
        self.promoted.subscribe()
    }

    /// Publishes all checkpoints and signatures written since the last call; a signature that is later than its checkpoint is
    /// added to the version. Faulty ones are ignored with a warning, until they are written anew.
    ///
    /// # Errors
    /// If the folder cannot be read.
    pub fn take_in(&self) -> anyhow::Result<()> {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        for path in files::list(&self.checkpoints)? {
            // Taken before the file is read: a file that is replaced meanwhile gets a stale stamp, and is read again.
            let (Some(model), Ok(metadata)) = (history::stem(&path), path.metadata()) else { continue };
            let signed = signature::path(&path).metadata().ok();
            let stamps = (stamp(&metadata), signed.as_ref().map(stamp));
            if seen.get(&model) == Some(&stamps) {
                continue;
            }

            // One byte beyond the limit, so that a larger file is refused as too large.
            let bytes = files::read_at_most(&path, cpn::checkpoint::MAX_BYTES + 1)
                .map_err(|e| Error::invalid("checkpoint", "a file that can be read", e));
            let published =
                bytes.and_then(|bytes| self.publish_signed(&model, &bytes, signature::beside(&path, &bytes)));
            if let Err(error) = published {
                warn!(path = %path.display(), %error, "checkpoint not published");
                if error.code == Code::Internal {
                    // It could not be written; the next call tries again.
                    continue;
                }
            }
            seen.insert(model, stamps);
        }
        Ok(())
    }

    /// Publishes and promotes a checkpoint as the next version of a model, unless it is the latest version already.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for a faulty checkpoint or name, with the reason; `INTERNAL` if it cannot be written.
    pub fn publish(&self, model: &str, bytes: &[u8]) -> Result<(), Error> {
        self.publish_signed(model, bytes, None)
    }

    /// Publishes a checkpoint with a signature, which is added to the latest version if that is the same checkpoint.
    fn publish_signed(&self, model: &str, bytes: &[u8], signature: Option<String>) -> Result<(), Error> {
        let checkpoint = cpn::checkpoint::from_bytes(bytes)
            .map_err(|e| Error::invalid("checkpoint", "one that can be loaded", e))?;

        let mut histories = self.histories();
        let mut history = histories.get(model).cloned().unwrap_or_default();
        let last = history.manifests().last();
        if last.is_some_and(|last| last.digest == checkpoint.digest) {
            let digest = checkpoint.digest;
            let weights = history::weights(&self.folder(model), &digest);
            if !history::is_whole(&weights, &digest) {
                warn!(model, digest, "weights were not what they were; written again");
                files::write_atomically(&weights, bytes).map_err(|e| unwritten(&e))?;
            }
            if signature.is_some_and(|bundle| history.sign(&digest, &bundle)) {
                self.store(&mut histories, model, history)?;
                info!(model, digest, "signature added");
            }
            return Ok(());
        }

        let manifest = history::valid(CheckpointManifest {
            model: model.to_owned(),
            version: last.map_or(1, |last| last.version + 1),
            parents: checkpoint.parents(),
            digest: checkpoint.digest,
            size_bytes: bytes.len() as u64,
            config_digest: checkpoint.config_digest,
            signature_bundle: signature,
        })?;
        let weights = history::weights(&self.folder(model), &manifest.digest);
        files::write_atomically(&weights, bytes).map_err(|e| unwritten(&e))?;
        history.add(manifest, self.keep);
        self.commit(&mut histories, model, history).map(drop)
    }

    /// Versions of a model, or of all models, whose weights are on disk.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown model.
    pub fn list(&self, request: ListVersionsRequest) -> Result<ListVersionsResponse, Error> {
        let histories = self.histories();
        let histories: Vec<&History> = match request.model {
            Some(model) => vec![find(&histories, &model)?],
            None => histories.values().collect(),
        };
        let versions = histories.into_iter().flat_map(|history| {
            let kept = history.manifests().iter().filter(|manifest| self.is_there(manifest));
            kept.map(|manifest| {
                let promoted = history.promoted()?.version == manifest.version;
                Ok(CheckpointVersion { manifest: manifest.clone(), promoted })
            })
        });
        Ok(ListVersionsResponse { versions: versions.collect::<Result<_, Error>>()? })
    }

    /// Promotes a version, which planners then serve.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown model or version; `FAILED_PRECONDITION` if its weights are missing or damaged; `INTERNAL` if
    /// the history cannot be written.
    pub fn promote(&self, request: PromoteVersionRequest) -> Result<PromoteVersionResponse, Error> {
        let PromoteVersionRequest { model, version } = request;
        let mut histories = self.histories();
        let mut history = find(&histories, &model)?.clone();
        let kept: Vec<u32> = history.manifests().iter().map(|manifest| manifest.version).collect();
        if !kept.contains(&version) {
            return Err(Error::new(Code::NotFound, "version", format!("one of {kept:?}"), version));
        }
        history.promote(version);
        self.check_whole(&history)?;
        Ok(PromoteVersionResponse { manifest: self.commit(&mut histories, &model, history)? })
    }

    /// Promotes the previously promoted version.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown model; `FAILED_PRECONDITION` if no other stored version was promoted before, or its weights are
    /// missing or damaged; `INTERNAL` if the history cannot be written.
    pub fn roll_back(&self, RollBackRequest { model }: RollBackRequest) -> Result<RollBackResponse, Error> {
        let mut histories = self.histories();
        let mut history = find(&histories, &model)?.clone();
        if !history.roll_back() {
            let expected = "one of which another version that is kept was promoted before";
            return Err(Error::new(Code::FailedPrecondition, "model", expected, model));
        }
        self.check_whole(&history)?;
        Ok(RollBackResponse { manifest: self.commit(&mut histories, &model, history)? })
    }

    /// Byte range of a version's checkpoint.
    ///
    /// # Errors
    /// `NOT_FOUND` for a digest of no version; `INVALID_ARGUMENT` for an offset beyond the end; `INTERNAL` if the file cannot be
    /// read.
    pub fn chunk(&self, request: CheckpointChunkRequest) -> Result<CheckpointChunkResponse, Error> {
        let CheckpointChunkRequest { digest, offset_bytes, length_bytes } = request;
        let histories = self.histories();
        let mut manifests = histories.values().flat_map(History::manifests);
        let CheckpointManifest { model, size_bytes, .. } = manifests
            .find(|manifest| manifest.digest == digest)
            .ok_or_else(|| Error::new(Code::NotFound, "digest", "that of a version that is kept", &digest))?;
        if offset_bytes >= *size_bytes {
            return Err(Error::invalid("offset_bytes", format!("less than {size_bytes}"), offset_bytes));
        }

        let mut data = vec![0; u64::from(length_bytes).min(size_bytes - offset_bytes) as usize];
        File::open(history::weights(&self.folder(model), &digest))
            .and_then(|file| file.read_exact_at(&mut data, offset_bytes))
            .map_err(|e| Error::new(Code::Internal, "digest", "weights that can be read", e))?;
        Ok(CheckpointChunkResponse { data })
    }

    /// Stores a history with a new promotion, logs it, and returns the promoted manifest.
    fn commit(
        &self,
        histories: &mut BTreeMap<String, History>,
        model: &str,
        history: History,
    ) -> Result<CheckpointManifest, Error> {
        let manifest = self.store(histories, model, history)?;
        info!(model, version = manifest.version, digest = manifest.digest, "promoted");
        Ok(manifest)
    }

    /// Writes a changed history, then publishes its announcement; returns the promoted manifest.
    fn store(
        &self,
        histories: &mut BTreeMap<String, History>,
        model: &str,
        history: History,
    ) -> Result<CheckpointManifest, Error> {
        let announcement = history.announcement()?;
        history.write(&self.folder(model)).map_err(|e| unwritten(&e))?;
        histories.insert(model.to_owned(), history);
        let manifest = announcement.manifest.clone();
        self.promoted.send_modify(|promoted| drop(promoted.insert(model.to_owned(), announcement)));
        Ok(manifest)
    }

    /// Whether a version's weights are on disk; only their size is compared.
    fn is_there(&self, CheckpointManifest { model, digest, size_bytes, .. }: &CheckpointManifest) -> bool {
        let weights = history::weights(&self.folder(model), digest);
        weights.metadata().is_ok_and(|metadata| metadata.len() == *size_bytes)
    }

    /// Checks that the weights of a history's promoted version are intact, since planners will fetch them.
    fn check_whole(&self, history: &History) -> Result<(), Error> {
        let CheckpointManifest { model, version, digest, .. } = history.promoted()?;
        let weights = history::weights(&self.folder(model), digest);
        if history::is_whole(&weights, digest) {
            return Ok(());
        }
        let got = format!("{version}, whose file {} is gone or damaged", weights.display());
        Err(Error::new(Code::FailedPrecondition, "version", "one whose weights are kept", got))
    }

    fn folder(&self, model: &str) -> PathBuf {
        self.checkpoints.join(VERSIONS).join(model)
    }

    fn histories(&self) -> MutexGuard<'_, BTreeMap<String, History>> {
        self.histories.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn find<'a>(histories: &'a BTreeMap<String, History>, model: &str) -> Result<&'a History, Error> {
    histories.get(model).ok_or_else(|| {
        let models: Vec<_> = histories.keys().map(String::as_str).collect();
        Error::new(Code::NotFound, "model", format!("one of {}", models.join(", ")), model)
    })
}

fn unwritten(error: &anyhow::Error) -> Error {
    Error::new(Code::Internal, "checkpoint", "one that can be written", format!("{error:#}"))
}
