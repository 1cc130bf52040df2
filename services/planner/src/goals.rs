//! Goal images as resources: registered once, named by their digest.

use lru::LruCache;
use std::num::NonZeroU16;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use wire::{Code, Error, Image};

/// The goals used last, by [`Image::digest`].
#[derive(Debug)]
pub(crate) struct Goals {
    images: Mutex<LruCache<String, Arc<Image>>>,
}

impl Goals {
    /// A store of at most `capacity` images.
    pub(crate) fn new(capacity: NonZeroU16) -> Self {
        Self { images: Mutex::new(LruCache::new(capacity.into())) }
    }

    /// Keeps an image, in place of the one unused for longest if the store is full; answers its id.
    pub(crate) fn register(&self, image: Image) -> (String, Arc<Image>) {
        let id = image.digest();
        let image = self.images().get_or_insert(id.clone(), || Arc::new(image)).clone();
        (id, image)
    }

    /// The image registered under an id.
    ///
    /// # Errors
    /// If there is none: it never was, or others took its place.
    pub(crate) fn get(&self, id: &str) -> Result<Arc<Image>, Error> {
        let mut images = self.images();
        let capacity = images.cap();
        images.get(id).cloned().ok_or_else(|| {
            Error::new(Code::NotFound, "goal_id", format!("one of the {capacity} goals registered last"), id)
        })
    }

    fn images(&self) -> MutexGuard<'_, LruCache<String, Arc<Image>>> {
        self.images.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
