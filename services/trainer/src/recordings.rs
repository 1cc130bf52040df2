//! A folder of recordings: `<task>/<episode id>.mcap`.

use anyhow::{Context, ensure};
use recording::Episode;
use service_kit::files;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tracing::warn;
use wire::demonstration::RecordedEpisode;
use wire::{Code, Error};

/// The recordings that one process keeps, known by their headers.
#[derive(Debug)]
pub struct Recordings {
    folder: PathBuf,
    index: Mutex<Index>,
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
    /// If the folder cannot be made or read, or its recordings differ in their render spec.
    pub fn open(folder: PathBuf) -> anyhow::Result<Self> {
        std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
        for task in tasks(&folder)? {
            files::remove_unfinished(&folder.join(task))?;
        }
        let mut index = Index::default();
        for path in paths(&folder)? {
            let header = match recording::read_header(&path) {
                Ok(header) => header,
                Err(error) => {
                    warn!(path = %path.display(), %error, "passed over");
                    continue;
                }
            };
            let expected = index.render_spec.get_or_insert_with(|| header.render_spec.clone());
            let (got, path) = (&header.render_spec, path.display());
            ensure!(expected == got, "{path}: render_spec: expected {expected:?} like the files before, got {got:?}");
            index.by_id.insert(header.episode.episode_id.clone(), header.episode);
        }
        Ok(Self { folder, index: Mutex::new(index) })
    }

    /// Whether an episode is kept.
    pub fn contains(&self, episode_id: &str) -> bool {
        self.index().by_id.contains_key(episode_id)
    }

    /// What is known of a kept episode.
    pub fn get(&self, episode_id: &str) -> Option<RecordedEpisode> {
        self.index().by_id.get(episode_id).cloned()
    }

    /// Every kept episode, by id.
    pub fn all(&self) -> Vec<RecordedEpisode> {
        self.index().by_id.values().cloned().collect()
    }

    /// Keeps an episode, on disk when this returns.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if it was rendered otherwise than those that are kept; `INTERNAL` if it cannot be written.
    pub fn keep(&self, episode: &Episode) -> Result<(), Error> {
        let info = episode.info();
        {
            let mut index = self.index();
            let expected = index.render_spec.get_or_insert_with(|| episode.render_spec().to_owned());
            if expected != episode.render_spec() {
                let got = episode.render_spec();
                return Err(Error::new(Code::FailedPrecondition, "frame.render_spec", &*expected, got));
            }
        }
        let path = path(&self.folder, info);
        let written = recording::to_bytes(episode).map_err(Into::into);
        let written = written.and_then(|bytes| files::write_atomically(&path, &bytes));
        written.map_err(|e| Error::new(Code::Internal, "episode_id", "a kept episode", format!("{e:#}")))?;
        self.index().by_id.insert(info.episode_id.clone(), info.clone());
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

/// Where an episode is kept.
fn path(folder: &Path, RecordedEpisode { episode_id, variation, .. }: &RecordedEpisode) -> PathBuf {
    folder.join(&variation.task).join(format!("{episode_id}.{}", recording::EXTENSION))
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

/// The digest of a dataset: SHA-256, in hex, over the task, seed and digest of each episode, in the order of
/// [`paths`]. How the files are compressed does not change it.
pub fn dataset_digest<'a>(episodes: impl IntoIterator<Item = &'a RecordedEpisode>) -> String {
    let mut hasher = Sha256::new();
    for RecordedEpisode { variation, digest, .. } in episodes {
        hasher.update(format!("{} {} {digest}\n", variation.task, variation.seed));
    }
    hex::encode(hasher.finalize())
}
