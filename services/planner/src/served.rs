//! The models that are served, with the checkpoints they had before.

use crate::model::Model;
use lru::LruCache;
use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use wire::{Code, Error};

/// The models that are served, by name.
pub(crate) struct Served {
    by_name: BTreeMap<String, Checkpoints>,
    retired_capacity: NonZeroUsize,
}

/// A model's checkpoints.
struct Checkpoints {
    /// The one that answers who asks for none.
    current: Model,
    /// Those that were swapped out, by digest: an episode that began with one may go on with it.
    retired: LruCache<String, Model>,
}

impl Served {
    pub(crate) fn new(models: Vec<Model>, retired_capacity: NonZeroUsize) -> Self {
        let mut served = Self { by_name: BTreeMap::new(), retired_capacity };
        for model in models {
            served.swap_in(model);
        }
        served
    }

    /// Serves a model in place of the one of its name, which is kept for those who ask for it.
    pub(crate) fn swap_in(&mut self, model: Model) {
        let retired = match self.by_name.remove(&model.info.name) {
            Some(Checkpoints { current, mut retired }) => {
                retired.pop(&model.info.digest);
                if current.info.digest != model.info.digest {
                    retired.put(current.info.digest.clone(), current);
                }
                retired
            }
            None => LruCache::new(self.retired_capacity),
        };
        self.by_name.insert(model.info.name.clone(), Checkpoints { current: model, retired });
    }

    /// The model of a name, with the checkpoint that must answer, if one must.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown name; `FAILED_PRECONDITION` for a checkpoint that is not kept.
    pub(crate) fn get(&mut self, name: &str, digest: Option<&str>) -> Result<&mut Model, Error> {
        if !self.by_name.contains_key(name) {
            return Err(unknown_model(name, self.by_name.keys()));
        }
        let Checkpoints { current, retired } = self.by_name.get_mut(name).expect("it is there");
        match digest {
            Some(digest) if digest != current.info.digest => {
                let kept = format!("{}, which is served, or one of {} kept before", current.info.digest, retired.len());
                retired
                    .get_mut(digest)
                    .ok_or_else(|| Error::new(Code::FailedPrecondition, "model_digest", kept, digest))
            }
            _ => Ok(current),
        }
    }
}

/// The named model is not among those served.
pub(crate) fn unknown_model<'a>(name: &str, served: impl Iterator<Item = &'a String>) -> Error {
    let served: Vec<_> = served.map(String::as_str).collect();
    Error::new(Code::NotFound, "model", format!("one of {}", served.join(", ")), name)
}
