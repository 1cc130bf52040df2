//! Served models, with their retired checkpoints.

use crate::model::Model;
use lru::LruCache;
use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use wire::planner::ModelInfo;
use wire::{Code, Error};

/// Served models, by name.
pub(crate) struct Served {
    by_name: BTreeMap<String, Checkpoints>,
    capacity: usize,
    retired_capacity: NonZeroUsize,
}

/// Shared model, which searches in progress keep alive after it was swapped out.
#[derive(Debug, Clone)]
pub(crate) struct Shared(Arc<Mutex<Model>>);

impl Shared {
    fn new(model: Model) -> Self {
        Self(Arc::new(Mutex::new(model)))
    }

    /// Locks the model; uncontended, since only the thread that owns the models does so.
    pub(crate) fn model(&self) -> MutexGuard<'_, Model> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Checkpoints of a model.
struct Checkpoints {
    /// SHA-256 of the current checkpoint, in hex.
    digest: String,
    /// Current checkpoint, for requests without a digest.
    current: Shared,
    /// Retired checkpoints by digest, for episodes that began with them.
    retired: LruCache<String, Shared>,
}

impl Served {
    /// Table of at most `capacity` models, with at most `retired_capacity` retired checkpoints each.
    pub(crate) fn new(capacity: usize, retired_capacity: NonZeroUsize) -> Self {
        Self { by_name: BTreeMap::new(), capacity, retired_capacity }
    }

    /// Serves a model in place of the one of its name, which is retired.
    ///
    /// # Errors
    /// `RESOURCE_EXHAUSTED` if the name is new and beyond the capacity.
    pub(crate) fn swap_in(&mut self, model: Model) -> Result<(), Error> {
        let ModelInfo { name, digest, .. } = model.info.clone();
        check_capacity(&name, self.by_name.keys(), self.capacity)?;
        let retired = match self.by_name.remove(&name) {
            Some(Checkpoints { digest: before, current, mut retired }) => {
                retired.pop(&digest);
                if before != digest {
                    retired.put(before, current);
                }
                retired
            }
            None => LruCache::new(self.retired_capacity),
        };
        self.by_name.insert(name, Checkpoints { digest, current: Shared::new(model), retired });
        Ok(())
    }

    /// Removes a model with all its checkpoints.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown name.
    pub(crate) fn remove(&mut self, name: &str) -> Result<(), Error> {
        let removed = self.by_name.remove(name);
        removed.map(drop).ok_or_else(|| unknown_model(name, self.by_name.keys()))
    }

    /// Model of a name and, if there is a `digest`, of that checkpoint, current or retired.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown name; `FAILED_PRECONDITION` for a checkpoint that is not kept.
    pub(crate) fn get(&mut self, name: &str, digest: Option<&str>) -> Result<Shared, Error> {
        if !self.by_name.contains_key(name) {
            return Err(unknown_model(name, self.by_name.keys()));
        }
        let Checkpoints { digest: served, current, retired } = self.by_name.get_mut(name).expect("it is there");
        match digest {
            Some(digest) if digest != served => {
                let kept = format!("{served}, which is served, or one of {} kept before", retired.len());
                let kept = |got| Error::new(Code::FailedPrecondition, "model_digest", kept, got);
                retired.get(digest).cloned().ok_or_else(|| kept(digest))
            }
            _ => Ok(current.clone()),
        }
    }
}

/// Checks the capacity for a model of this name.
///
/// # Errors
/// `RESOURCE_EXHAUSTED` if the name is new and beyond the capacity.
pub(crate) fn check_capacity<'a>(
    name: &str,
    mut served: impl ExactSizeIterator<Item = &'a String>,
    capacity: usize,
) -> Result<(), Error> {
    if served.len() < capacity || served.any(|served| served == name) {
        return Ok(());
    }
    let expected = format!("one of the {capacity} that are served, or one of them unloaded");
    Err(Error::new(Code::ResourceExhausted, "model", expected, name))
}

/// Error of a model name that is not served.
pub(crate) fn unknown_model<'a>(name: &str, served: impl Iterator<Item = &'a String>) -> Error {
    let served: Vec<_> = served.map(String::as_str).collect();
    Error::new(Code::NotFound, "model", format!("one of {}", served.join(", ")), name)
}
