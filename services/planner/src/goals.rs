//! Store of registered goals, by digest.

use lru::LruCache;
use std::num::NonZeroU16;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use wire::{Code, Error, Observation};

/// LRU store of goals, by [`Observation::digest`].
#[derive(Debug)]
pub(crate) struct Goals {
    goals: Mutex<LruCache<String, Arc<Observation>>>,
}

impl Goals {
    /// Store of at most `capacity` goals.
    pub(crate) fn new(capacity: NonZeroU16) -> Self {
        Self { goals: Mutex::new(LruCache::new(capacity.into())) }
    }

    /// Registers a goal and returns its id; a full store evicts the least recently used goal.
    pub(crate) fn register(&self, goal: Observation) -> (String, Arc<Observation>) {
        let id = goal.digest();
        let goal = self.goals().get_or_insert(id.clone(), || Arc::new(goal)).clone();
        (id, goal)
    }

    /// Goal of an id.
    ///
    /// # Errors
    /// `NOT_FOUND` if the goal was never registered, or was evicted.
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
