//! Takes in demonstration streams.
//!
//! Steps are numbered and never acknowledged one by one: the sender commits an episode, and the answer tells which
//! steps are still missing. An episode that is kept already answers that nothing is, so that a sender can always begin
//! by committing, and a stream can be sent again without harm. What is lost on the way, or dropped because too many
//! episodes are under way, is missing at the next commit, and so is never lost for good.

use crate::record::folder::Recordings;
use crate::record::frame;
use recording::Episode;
use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tracing::info;
use wire::demonstration::{CommitEpisodeRequest, DemonstrationStep, RecordedEpisode};
use wire::{Code, Error};

/// How much may be under way.
#[derive(Debug, Clone)]
pub struct Limits {
    /// Episodes at once; each may take as much memory as 1000 frames. A new one waits until another is kept.
    pub episodes: usize,
    /// An episode that nobody has sent a step of for so long is given up.
    pub silence: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self { episodes: 16, silence: Duration::from_secs(30) }
    }
}

/// What a commit led to.
#[derive(Debug, Clone, PartialEq)]
pub enum Commit {
    /// These steps are to be sent again.
    Missing(Vec<u32>),
    /// The episode is on disk since now.
    Kept,
    /// The episode was on disk before.
    KeptBefore,
}

/// Episodes under way, and those that are kept.
#[derive(Debug)]
pub struct Ingest {
    recordings: Arc<Recordings>,
    limits: Limits,
    open: Mutex<HashMap<String, Open>>,
}

/// An episode under way.
#[derive(Debug)]
struct Open {
    steps: BTreeMap<u32, DemonstrationStep>,
    /// Why it can no longer be kept; the next commit is told.
    fault: Option<Error>,
    heard: Instant,
}

impl Ingest {
    /// Keeps episodes among `recordings`.
    pub fn new(recordings: Arc<Recordings>, limits: Limits) -> Self {
        Self { recordings, limits, open: Mutex::default() }
    }

    /// Takes in one step; a step that is there already is replaced. A frame of another size is not held, which bounds
    /// what a stranger's stream can take.
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

    /// Keeps an episode if every step is there, else answers which are missing.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` if the steps do not make the episode, which is then forgotten; `FAILED_PRECONDITION` if another
    /// one is kept under its id, or it was rendered otherwise than those that are kept; `RESOURCE_EXHAUSTED` if too many
    /// are under way; `INTERNAL` if the file cannot be written.
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

    /// The place of an episode under way, which is heard of now; none if all places are taken.
    fn place<'a>(&self, open: &'a mut HashMap<String, Open>, episode_id: &str) -> Option<&'a mut Open> {
        let now = Instant::now();
        if !open.contains_key(episode_id) && open.len() >= self.limits.episodes {
            open.retain(|_, episode| now - episode.heard < self.limits.silence);
            if open.len() >= self.limits.episodes {
                return None;
            }
        }
        let new = || Open { steps: BTreeMap::new(), fault: None, heard: now };
        let episode = open.entry(episode_id.to_owned()).or_insert_with(new);
        episode.heard = now;
        Some(episode)
    }

    fn full(&self) -> Error {
        Error::new(Code::ResourceExhausted, "episode_id", "a free place", format!("{} under way", self.limits.episodes))
    }

    fn open(&self) -> MutexGuard<'_, HashMap<String, Open>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
