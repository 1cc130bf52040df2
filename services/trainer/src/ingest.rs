//! Keeps the episodes of demonstration streams.
//!
//! Steps are numbered and never acknowledged one by one: the sender commits an episode, and the answer tells which
//! steps are still missing. An episode that is kept already answers that nothing is, so that a sender can always begin
//! by committing, and a stream can be sent again without harm.

use crate::episode::{self, Episode};
use lru::LruCache;
use service_kit::files;
use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tracing::{info, warn};
use wire::demonstration::{CommitEpisodeRequest, CommitEpisodeResponse, DemonstrationStep};
use wire::{Code, Error, key, query};
use zenoh::Session;

/// Episodes that may be under way at once; past that, the one that was silent longest is given up.
const MAX_OPEN_EPISODES: NonZeroUsize = NonZeroUsize::new(64).expect("not zero");

/// An episode under way.
#[derive(Debug, Default)]
struct Open {
    steps: BTreeMap<u32, DemonstrationStep>,
    /// Why it can no longer be kept; the next commit is told.
    fault: Option<Error>,
}

/// Episodes under way, and the folder of those that are kept.
#[derive(Debug)]
pub struct Ingest {
    folder: PathBuf,
    open: Mutex<LruCache<String, Open>>,
}

impl Ingest {
    /// Keeps episodes as `folder/<task>/<episode id>.safetensors`.
    pub fn new(folder: PathBuf) -> Self {
        Self { folder, open: Mutex::new(LruCache::new(MAX_OPEN_EPISODES)) }
    }

    /// Takes in one step; a step that is there already is replaced. A frame of another size is not held, which bounds
    /// what a stranger's stream can take.
    pub fn step(&self, step: DemonstrationStep) {
        let mut open = self.open();
        let episode = open.get_or_insert_mut(step.episode_id.clone(), Open::default);
        match episode::check_frame(&step) {
            Ok(()) => drop(episode.steps.insert(step.step, step)),
            Err(fault) => episode.fault = Some(fault),
        }
    }

    /// Keeps an episode if every step is there, else answers which are missing.
    ///
    /// # Errors
    /// If the steps do not make an episode, which is then forgotten, or the file cannot be written.
    pub fn commit(&self, request: &CommitEpisodeRequest) -> Result<CommitEpisodeResponse, Error> {
        let path = episode_path(&self.folder, &request.variation.task, &request.episode_id);
        if path.exists() {
            self.open().pop(&request.episode_id);
            return Ok(CommitEpisodeResponse { missing_steps: Vec::new() });
        }
        let steps = {
            let mut open = self.open();
            let mut episode = open.pop(&request.episode_id).unwrap_or_default();
            if let Some(fault) = episode.fault.take() {
                return Err(fault);
            }
            let missing_steps: Vec<u32> = (0..request.steps).filter(|step| !episode.steps.contains_key(step)).collect();
            if !missing_steps.is_empty() {
                open.put(request.episode_id.clone(), episode);
                return Ok(CommitEpisodeResponse { missing_steps });
            }
            episode.steps
        };
        if let Some((&extra, _)) = steps.range(request.steps..).next() {
            return Err(Error::invalid("steps", format!("all steps below {}", request.steps), extra));
        }
        let episode = Episode::from_steps(request, &steps.into_values().collect::<Vec<_>>())?;
        let written = episode.to_bytes().and_then(|bytes| files::write_atomically(&path, &bytes));
        written.map_err(|e| Error::new(Code::Internal, "episode_id", "a kept episode", format!("{e:#}")))?;
        info!(episode = request.episode_id, steps = request.steps, "kept");
        Ok(CommitEpisodeResponse { missing_steps: Vec::new() })
    }

    fn open(&self) -> MutexGuard<'_, LruCache<String, Open>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Where an episode is kept.
fn episode_path(folder: &Path, task: &str, episode_id: &str) -> PathBuf {
    folder.join(task).join(format!("{episode_id}.safetensors"))
}

/// Serves demonstration streams until the session closes.
///
/// # Errors
/// If zenoh refuses a declaration.
pub async fn serve(session: &Session, ingest: Arc<Ingest>) -> zenoh::Result<()> {
    let receiver = Arc::clone(&ingest);
    // The callback only copies a frame. It must be done before the next message is read: a commit follows its steps.
    let _steps = session
        .declare_subscriber(key::demonstration_step("*", "*")?)
        .callback(move |sample| match wire::decode(&sample.payload().to_bytes()) {
            Ok(step) => receiver.step(step),
            Err(error) => warn!(key = %sample.key_expr(), %error, "step refused"),
        })
        .await?;
    let commits = session.declare_queryable(key::demonstration_commit("*")?).complete(true).await?;
    while let Ok(query) = commits.recv_async().await {
        let ingest = Arc::clone(&ingest);
        let answered = tokio::task::spawn_blocking(move || {
            let answer = query::request(&query).and_then(|request| ingest.commit(&request));
            if let Err(error) = &answer {
                warn!(key = %query.key_expr(), %error, "commit refused");
            }
            query::reply(&query, answer)
        });
        answered.await??;
    }
    Ok(())
}
