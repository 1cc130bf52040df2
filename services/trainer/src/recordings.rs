//! A folder of recordings: `<task>/<episode id>.mcap`.

use anyhow::{Context, ensure};
use recording::Episode;
use service_kit::files;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tracing::warn;
use wire::demonstration::RecordedEpisode;
use wire::{Code, Error};

/// The recordings that one process keeps, known by their headers.
#[derive(Debug)]
pub struct Recordings {
    folder: PathBuf,
    /// Held as long as this lives.
    _lock: File,
    index: Mutex<Index>,
    /// Held from the check to the entry: two episodes of one id are never written both.
    writing: Mutex<()>,
}

#[derive(Debug, Default)]
struct Index {
    by_id: BTreeMap<String, RecordedEpisode>,
    /// Of every episode; none before the first.
    render_spec: Option<String>,
}

impl Recordings {
    /// Takes over a folder: removes what a killed process left unfinished and reads every header. A file that is no
    /// recording is passed over; when its episode comes again, it takes the file's place.
    ///
    /// # Errors
    /// If the folder cannot be made or read, another process has it, or its recordings differ in their render spec.
    pub fn open(folder: PathBuf) -> anyhow::Result<Self> {
        let lock = files::take_over(&folder)?;
        for task in tasks(&folder)? {
            files::remove_unfinished(&folder.join(task))?;
        }
        let mut index = Index::default();
        for path in paths(&folder)? {
            let header = || check_place(&folder, &path, recording::read_header(&path)?);
            let info = match header() {
                Ok(info) => info,
                Err(error) => {
                    warn!(path = %path.display(), error = format!("{error:#}"), "passed over");
                    continue;
                }
            };
            let expected = index.render_spec.get_or_insert_with(|| info.render_spec.clone());
            let (got, path) = (&info.render_spec, path.display());
            ensure!(expected == got, "{path}: render_spec: expected {expected:?} like the files before, got {got:?}");
            index.by_id.insert(info.episode_id.clone(), info);
        }
        Ok(Self { folder, _lock: lock, index: Mutex::new(index), writing: Mutex::new(()) })
    }

    /// Whether an episode is kept.
    pub fn contains(&self, episode_id: &str) -> bool {
        self.index().by_id.contains_key(episode_id)
    }

    /// What is known of a kept episode.
    pub fn get(&self, episode_id: &str) -> Option<RecordedEpisode> {
        self.index().by_id.get(episode_id).cloned()
    }

    /// How many episodes are kept.
    pub fn count(&self) -> usize {
        self.index().by_id.len()
    }

    /// Every kept episode, by id.
    pub fn all(&self) -> Vec<RecordedEpisode> {
        self.index().by_id.values().cloned().collect()
    }

    /// Whether an episode is still to be kept; if not, the same one is kept already.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if another one is kept under its id, or it was rendered otherwise than those that are kept.
    pub fn lacks(&self, offered: &RecordedEpisode) -> Result<bool, Error> {
        let index = self.index();
        let refused =
            |field, expected: &str, got: &str| Err(Error::new(Code::FailedPrecondition, field, expected, got));
        if let Some(kept) = index.by_id.get(&offered.episode_id) {
            return match fields(kept).into_iter().zip(fields(offered)).find(|(kept, offered)| kept != offered) {
                Some(((field, expected), (_, got))) => refused(field, &expected, &got),
                None => Ok(false),
            };
        }
        match &index.render_spec {
            Some(expected) if *expected != offered.render_spec => {
                refused("render_spec", expected, &offered.render_spec)
            }
            _ => Ok(true),
        }
    }

    /// Keeps an episode, on disk when this returns, unless it is kept already.
    ///
    /// # Errors
    /// Those of [`Self::lacks`]; `INTERNAL` if it cannot be written.
    pub fn keep(&self, episode: &Episode) -> Result<(), Error> {
        let _writing = self.writing.lock().unwrap_or_else(PoisonError::into_inner);
        let info = episode.info();
        if !self.lacks(info)? {
            return Ok(());
        }
        let path = path(&self.folder, info);
        let written = recording::to_bytes(episode).map_err(Into::into);
        let written = written.and_then(|bytes| files::write_atomically(&path, &bytes));
        written.map_err(|e| Error::new(Code::Internal, "episode_id", "a kept episode", format!("{e:#}")))?;
        let mut index = self.index();
        index.render_spec = Some(info.render_spec.clone());
        index.by_id.insert(info.episode_id.clone(), info.clone());
        Ok(())
    }

    /// Reads a kept episode; none if there is no such.
    ///
    /// # Errors
    /// `INTERNAL` if its file is damaged.
    pub fn read(&self, episode_id: &str) -> Result<Option<Episode>, Error> {
        let Some(info) = self.get(episode_id) else { return Ok(None) };
        let read = recording::read(&path(&self.folder, &info));
        read.map(Some).map_err(|e| Error::new(Code::Internal, "episode_id", "a whole recording", e))
    }

    fn index(&self) -> MutexGuard<'_, Index> {
        self.index.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What is known of an episode, by field.
fn fields(episode: &RecordedEpisode) -> [(&'static str, String); 6] {
    let RecordedEpisode { episode_id: _, variation, steps, digest, goal_position, control_hz, render_spec } = episode;
    [
        ("digest", digest.clone()),
        ("render_spec", render_spec.clone()),
        ("variation", format!("{variation:?}")),
        ("steps", steps.to_string()),
        ("goal_position", format!("{goal_position:?}")),
        ("control_hz", control_hz.to_string()),
    ]
}

/// Where an episode is kept.
fn path(folder: &Path, RecordedEpisode { episode_id, variation, .. }: &RecordedEpisode) -> PathBuf {
    folder.join(&variation.task).join(format!("{episode_id}.{}", recording::EXTENSION))
}

/// Checks that a recording lies where its header says: by its place it is told apart, held out, and found again.
fn check_place(folder: &Path, found: &Path, info: RecordedEpisode) -> anyhow::Result<RecordedEpisode> {
    let expected = path(folder, &info);
    ensure!(found == expected, "place: expected {}, got {}", expected.display(), found.display());
    Ok(info)
}

/// Reads a recording of a folder.
///
/// # Errors
/// If it is damaged, or does not lie where its header says.
pub fn read(folder: &Path, path: &Path) -> anyhow::Result<Episode> {
    let read = || {
        let episode = recording::read(path)?;
        check_place(folder, path, episode.info().clone())?;
        anyhow::Ok(episode)
    };
    read().with_context(|| path.display().to_string())
}

/// The names of the tasks of a folder, in order.
///
/// # Errors
/// If the folder cannot be read.
pub fn tasks(folder: &Path) -> anyhow::Result<Vec<String>> {
    names(folder, |path| path.is_dir())
}

/// The recordings of a folder, in order of task and name.
///
/// # Errors
/// If the folder cannot be read.
pub fn paths(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut paths = Vec::new();
    for task in tasks(folder)? {
        let folder = folder.join(task);
        let names = names(&folder, |path| path.extension().is_some_and(|e| e == recording::EXTENSION))?;
        paths.extend(names.into_iter().map(|name| folder.join(name)));
    }
    Ok(paths)
}

fn names(folder: &Path, wanted: impl Fn(&Path) -> bool) -> anyhow::Result<Vec<String>> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let entry = entry?;
        if wanted(&entry.path()) {
            names.push(entry.file_name().to_string_lossy().into_owned());
        }
    }
    names.sort();
    Ok(names)
}

/// The digest of a dataset: SHA-256, in hex, over what is known of each episode, its digest and render spec included, in the
/// order of [`paths`]. How the files are compressed does not change it.
pub fn dataset_digest<'a>(episodes: impl IntoIterator<Item = &'a RecordedEpisode>) -> String {
    let mut hasher = Sha256::new();
    for episode in episodes {
        hasher.update(format!("{} {:?}\n", episode.episode_id, fields(episode)));
    }
    hex::encode(hasher.finalize())
}
