//! The models that are served, with the checkpoints they had before.

use crate::model::Model;
use lru::LruCache;
use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use wire::planner::ModelInfo;
use wire::{Code, Error};

/// The models that are served, by name.
pub(crate) struct Served {
    by_name: BTreeMap<String, Checkpoints>,
    capacity: usize,
    retired_capacity: NonZeroUsize,
}

/// A model that searches may go on with after it is gone from here.
#[derive(Debug, Clone)]
pub(crate) struct Shared(Arc<Mutex<Model>>);

impl Shared {
    fn new(model: Model) -> Self {
        Self(Arc::new(Mutex::new(model)))
    }

    /// Whoever has the models has it at once.
    pub(crate) fn model(&self) -> MutexGuard<'_, Model> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A model's checkpoints.
struct Checkpoints {
    /// Of the one that is current.
    digest: String,
    /// The one that answers who asks for none.
    current: Shared,
    /// Those that were swapped out, by digest: an episode that began with one may go on with it.
    retired: LruCache<String, Shared>,
}

impl Served {
    /// Room for `capacity` names, and for so many checkpoints of each that were swapped out.
    pub(crate) fn new(capacity: usize, retired_capacity: NonZeroUsize) -> Self {
        Self { by_name: BTreeMap::new(), capacity, retired_capacity }
    }

    /// Serves a model in place of the one of its name, which is kept for those who ask for it.
    ///
    /// # Errors
    /// `RESOURCE_EXHAUSTED` if the name is new and one too many.
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

    /// Forgets a model, with all its checkpoints.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown name.
    pub(crate) fn remove(&mut self, name: &str) -> Result<(), Error> {
        let removed = self.by_name.remove(name);
        removed.map(drop).ok_or_else(|| unknown_model(name, self.by_name.keys()))
    }

    /// The model of a name, with the checkpoint that must answer, if one must.
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

/// Whether there is room for a model of this name.
///
/// # Errors
/// `RESOURCE_EXHAUSTED` if the name is new and one too many.
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

/// The named model is not among those served.
pub(crate) fn unknown_model<'a>(name: &str, served: impl Iterator<Item = &'a String>) -> Error {
    let served: Vec<_> = served.map(String::as_str).collect();
    Error::new(Code::NotFound, "model", format!("one of {}", served.join(", ")), name)
}
