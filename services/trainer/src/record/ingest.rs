//! Ingest of demonstration streams.
//!
//! Steps are numbered, and not acknowledged one by one: the sender commits an episode, and the answer lists the missing steps.
//! For a stored episode the list is empty, so that a sender can begin with a commit, and sending again is idempotent. Steps that
//! are lost in transit, or dropped because too many episodes are in progress, are listed by the next commit and sent again.

use crate::record::folder::Recordings;
use crate::record::frame;
use recording::Episode;
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tracing::info;
use wire::demonstration::{CommitEpisodeRequest, DemonstrationStep, RecordedEpisode};
use wire::{Code, Error};

/// Limits of episodes in progress.
#[derive(Debug, Clone)]
pub struct Limits {
    /// Maximum number of episodes in progress, each of up to 1000 frames in memory. A new one waits until another is stored.
    pub episodes: usize,
    /// Time without a step after which an episode in progress may be dropped.
    pub silence: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self { episodes: 16, silence: Duration::from_secs(30) }
    }
}

/// Outcome of a commit.
#[derive(Debug, Clone, PartialEq)]
pub enum Commit {
    /// Steps to send again.
    Missing(Vec<u32>),
    /// Episode stored by this commit.
    Kept,
    /// Episode stored before.
    KeptBefore,
}

/// Ingest of episodes, with those in progress.
#[derive(Debug)]
pub struct Ingest {
    recordings: Arc<Recordings>,
    limits: Limits,
    open: Mutex<HashMap<String, Open>>,
}

/// Episode in progress.
#[derive(Debug)]
struct Open {
    steps: BTreeMap<u32, DemonstrationStep>,
    /// Error that the next commit is refused with.
    fault: Option<Error>,
    last_step: Instant,
}

impl Ingest {
    /// Ingest into `recordings`.
    pub fn new(recordings: Arc<Recordings>, limits: Limits) -> Self {
        Self { recordings, limits, open: Mutex::default() }
    }

    /// Adds a step to its episode in progress; a later one of the same number replaces it. Frames of another size are dropped,
    /// which bounds the memory of untrusted streams.
    pub fn step(&self, step: DemonstrationStep) {
        if self.recordings.contains(&step.episode_id) {
            return;
        }
        let mut open = self.open();
        let Some(episode) = self.place(&mut open, &step.episode_id) else { return };
        match frame::check(&step) {
            Ok(()) => drop(episode.steps.insert(step.step, step)),
            Err(fault) => episode.fault = Some(fault),
        }
    }

    /// Stores an episode if all its steps have arrived, else returns the missing ones.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` if the steps are not a valid episode, which is then dropped; `FAILED_PRECONDITION` if a different
    /// episode is stored under its id, or its render spec is not that of the dataset; `RESOURCE_EXHAUSTED` if too many episodes
    /// are in progress; `INTERNAL` if the file cannot be written.
    pub fn commit(&self, request: &CommitEpisodeRequest) -> Result<Commit, Error> {
        let RecordedEpisode { episode_id, steps: count, .. } = &request.episode;
        let lacking = self.recordings.lacks(&request.episode);
        if !matches!(lacking, Ok(true)) {
            self.open().remove(episode_id);
            return lacking.map(|_| Commit::KeptBefore);
        }

        let steps = {
            let mut open = self.open();
            let episode = self.place(&mut open, episode_id).ok_or_else(|| self.full())?;
            if let Some(fault) = episode.fault.take() {
                open.remove(episode_id);
                return Err(fault);
            }
            let missing: Vec<u32> = (0..*count).filter(|step| !episode.steps.contains_key(step)).collect();
            if !missing.is_empty() {
                return Ok(Commit::Missing(missing));
            }
            let steps = std::mem::take(&mut episode.steps);
            open.remove(episode_id);
            steps
        };

        if let Some((&extra, _)) = steps.range(count..).next() {
            return Err(Error::invalid("steps", format!("all steps below {count}"), extra));
        }
        self.recordings.keep(&Episode::new(request.episode.clone(), steps.into_values().collect())?)?;
        metrics::counter!("cpn_recorder_episodes_total").increment(1);
        metrics::counter!("cpn_recorder_steps_total").increment((*count).into());
        info!(episode = episode_id, steps = count, "kept");
        Ok(Commit::Kept)
    }

    /// Entry of an episode in progress, created if there is none; none if there are too many.
    fn place<'a>(&self, open: &'a mut HashMap<String, Open>, episode_id: &str) -> Option<&'a mut Open> {
        let now = Instant::now();
        if !open.contains_key(episode_id) && open.len() >= self.limits.episodes {
            open.retain(|_, episode| now - episode.last_step < self.limits.silence);
            if open.len() >= self.limits.episodes {
                return None;
            }
        }
        let new = || Open { steps: BTreeMap::new(), fault: None, last_step: now };
        let episode = open.entry(episode_id.to_owned()).or_insert_with(new);
        episode.last_step = now;
        Some(episode)
    }

    fn full(&self) -> Error {
        Error::new(Code::ResourceExhausted, "episode_id", "a free place", format!("{} under way", self.limits.episodes))
    }

    fn open(&self) -> MutexGuard<'_, HashMap<String, Open>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
