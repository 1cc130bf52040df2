//! Goals as resources: registered once, named by their digest.

use lru::LruCache;
use std::num::NonZeroU16;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use wire::{Code, Error, Observation};

/// The goals used last, by [`Observation::digest`].
#[derive(Debug)]
pub(crate) struct Goals {
    goals: Mutex<LruCache<String, Arc<Observation>>>,
}

impl Goals {
    /// A store of at most `capacity` goals.
    pub(crate) fn new(capacity: NonZeroU16) -> Self {
        Self { goals: Mutex::new(LruCache::new(capacity.into())) }
    }

    /// Keeps a goal, in place of the one unused for longest if the store is full; answers its id.
    pub(crate) fn register(&self, goal: Observation) -> (String, Arc<Observation>) {
        let id = goal.digest();
        let goal = self.goals().get_or_insert(id.clone(), || Arc::new(goal)).clone();
        (id, goal)
    }

    /// The goal registered under an id.
    ///
    /// # Errors
    /// If there is none: it never was, or others took its place.
    pub(crate) fn get(&self, id: &str) -> Result<Arc<Observation>, Error> {
        let mut goals = self.goals();
        let capacity = goals.cap();
        goals.get(id).cloned().ok_or_else(|| {
            Error::new(Code::NotFound, "goal_id", format!("one of the {capacity} goals registered last"), id)
        })
    }

    fn goals(&self) -> MutexGuard<'_, LruCache<String, Arc<Observation>>> {
        self.goals.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
