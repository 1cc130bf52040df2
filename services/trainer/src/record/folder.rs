//! Dataset folder: recordings as `<task>/<episode id>.mcap`.

use anyhow::{Context, ensure};
use rayon::prelude::*;
use recording::Episode;
use service_kit::files;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tracing::warn;
use wire::demonstration::RecordedEpisode;
use wire::{Code, Error};

/// Index of a dataset folder, locked against other processes. Lookups check the file on disk: an episode whose file was removed,
/// truncated or replaced is not reported as stored.
#[derive(Debug)]
pub struct Recordings {
    folder: PathBuf,
    /// Lock of the folder.
    _lock: File,
    index: Mutex<Index>,
    /// Held from the check to the entry in the index, so that two episodes of one id are never both written.
    writing: Mutex<()>,
}

/// Episodes whose files were intact when read, by id.
#[derive(Debug, Default)]
struct Index(BTreeMap<String, Kept>);

/// Stored episode: the metadata of an intact file, and the file's stamp.
#[derive(Debug, Clone)]
struct Kept {
    info: RecordedEpisode,
    stamp: Stamp,
}

/// Stamp that changes with every write to a file: inode, size, and change time in seconds and nanoseconds.
type Stamp = (u64, u64, i64, i64);

fn stamp(path: &Path) -> std::io::Result<Stamp> {
    let metadata = path.metadata()?;
    Ok((metadata.ino(), metadata.len(), metadata.ctime(), metadata.ctime_nsec()))
}

impl Kept {
    /// Reads and validates a whole recording.
    fn read(folder: &Path, found: &Path) -> anyhow::Result<Self> {
        // Taken before the read: a file that is replaced meanwhile gets a stale stamp, and is read again.
        let stamp = stamp(found)?;
        let info = read(folder, found)?.info().clone();
        Ok(Self { info, stamp })
    }
}

impl Index {
    /// Metadata of a stored episode; a changed file is read again, a missing or damaged one removed from the index.
    fn get(&mut self, folder: &Path, episode_id: &str) -> Option<&RecordedEpisode> {
        let Kept { info, stamp: known } = self.0.get(episode_id)?;
        let path = path(folder, info);
        if stamp(&path).ok() != Some(*known) {
            self.refresh(folder, episode_id, &path);
        }
        self.0.get(episode_id).map(|kept| &kept.info)
    }

    /// Updates the entry of an episode from its file, which may be new, changed or missing.
    fn refresh(&mut self, folder: &Path, episode_id: &str, path: &Path) {
        match Kept::read(folder, path) {
            Ok(kept) => drop(self.0.insert(episode_id.to_owned(), kept)),
            Err(error) => {
                if self.0.remove(episode_id).is_some() {
                    warn!(episode_id, error = format!("{error:#}"), "not kept any more");
                }
            }
        }
    }

    /// Metadata of all stored episodes, ordered by id.
    fn all(&mut self, folder: &Path) -> Vec<RecordedEpisode> {
        let ids: Vec<_> = self.0.keys().cloned().collect();
        ids.iter().filter_map(|id| self.get(folder, id).cloned()).collect()
    }

    /// Render spec of the dataset, the same for all episodes; none if there are none.
    fn render_spec(&mut self, folder: &Path) -> Option<String> {
        while let Some(id) = self.0.keys().next().cloned() {
            if let Some(info) = self.get(folder, &id) {
                return Some(info.render_spec.clone());
            }
        }
        None
    }
}

impl Recordings {
    /// Opens and locks a folder: removes temporary files of killed processes, and reads all recordings, on all cores. Damaged
    /// files are skipped; their episodes, when sent again, replace them.
    ///
    /// # Errors
    /// If the folder cannot be created or read, another process has it, or its recordings differ in their render spec.
    pub fn open(folder: PathBuf) -> anyhow::Result<Self> {
        let lock = files::take_over(&folder)?;
        for task in tasks(&folder)? {
            files::remove_unfinished(&folder.join(task))?;
        }

        let paths = paths(&folder)?;
        let read: Vec<_> = paths.par_iter().map(|path| Kept::read(&folder, path)).collect();
        let mut index: BTreeMap<String, Kept> = BTreeMap::new();
        for (path, read) in paths.iter().zip(read) {
            let kept = match read {
                Ok(kept) => kept,
                Err(error) => {
                    warn!(error = format!("{error:#}"), "passed over");
                    continue;
                }
            };

            let (info, path) = (&kept.info, path.display());
            if let Some(first) = index.values().next() {
                let (expected, got) = (&first.info.render_spec, &info.render_spec);
                ensure!(
                    expected == got,
                    "{path}: render_spec: expected {expected:?} like the files before, got {got:?}"
                );
            }
            if let Some(Kept { info: first, .. }) = index.get(&info.episode_id) {
                warn!("{path}: passed over: its id is that of an episode of {}", first.variation.task);
                continue;
            }
            index.insert(info.episode_id.clone(), kept);
        }
        Ok(Self { folder, _lock: lock, index: Mutex::new(Index(index)), writing: Mutex::new(()) })
    }

    /// Whether an episode is in the index; its file is not checked.
    pub fn contains(&self, episode_id: &str) -> bool {
        self.index().0.contains_key(episode_id)
    }

    /// Metadata of a stored episode.
    pub fn get(&self, episode_id: &str) -> Option<RecordedEpisode> {
        self.index().get(&self.folder, episode_id).cloned()
    }

    /// Number of stored episodes.
    pub fn count(&self) -> usize {
        self.all().len()
    }

    /// Metadata of all stored episodes, ordered by id.
    pub fn all(&self) -> Vec<RecordedEpisode> {
        self.index().all(&self.folder)
    }

    /// Whether an episode is missing; false if the same one is stored.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if a different episode is stored under its id, or its render spec is not that of the dataset.
    pub fn lacks(&self, offered: &RecordedEpisode) -> Result<bool, Error> {
        let mut index = self.index();
        let refused =
            |field, expected: &str, got: &str| Err(Error::new(Code::FailedPrecondition, field, expected, got));

        if !index.0.contains_key(&offered.episode_id) {
            // The file may have been copied into the folder meanwhile.
            let path = path(&self.folder, offered);
            if path.exists() {
                index.refresh(&self.folder, &offered.episode_id, &path);
            }
        }
        if let Some(kept) = index.get(&self.folder, &offered.episode_id) {
            return match fields(kept).into_iter().zip(fields(offered)).find(|(kept, offered)| kept != offered) {
                Some(((field, expected), (_, got))) => refused(field, &expected, &got),
                None => Ok(false),
            };
        }

        match index.render_spec(&self.folder) {
            Some(expected) if expected != offered.render_spec => {
                refused("render_spec", &expected, &offered.render_spec)
            }
            _ => Ok(true),
        }
    }

    /// Stores an episode, unless the same one is stored; it is durable when this returns.
    ///
    /// # Errors
    /// The errors of [`Self::lacks`]; `INTERNAL` if the file cannot be written.
    pub fn keep(&self, episode: &Episode) -> Result<(), Error> {
        let _writing = self.writing.lock().unwrap_or_else(PoisonError::into_inner);
        let info = episode.info();
        if !self.lacks(info)? {
            return Ok(());
        }
        let path = path(&self.folder, info);
        let write = || {
            files::write_atomically(&path, &recording::to_bytes(episode)?)?;
            anyhow::Ok(stamp(&path)?)
        };
        let stamp =
            write().map_err(|e| Error::new(Code::Internal, "episode_id", "a kept episode", format!("{e:#}")))?;
        self.index().0.insert(info.episode_id.clone(), Kept { info: info.clone(), stamp });
        Ok(())
    }

    /// Reads a stored episode; none for an unknown id.
    ///
    /// # Errors
    /// `INTERNAL` if its file is damaged, which also removes it from the index.
    pub fn read(&self, episode_id: &str) -> Result<Option<Episode>, Error> {
        let Some(info) = self.get(episode_id) else { return Ok(None) };
        let path = path(&self.folder, &info);
        read(&self.folder, &path).map(Some).map_err(|e| {
            self.index().refresh(&self.folder, episode_id, &path);
            Error::new(Code::Internal, "episode_id", "a whole recording", format!("{e:#}"))
        })
    }

    fn index(&self) -> MutexGuard<'_, Index> {
        self.index.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Metadata of an episode without its id, as names and texts of the fields.
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

/// Path of an episode's recording.
fn path(folder: &Path, RecordedEpisode { episode_id, variation, .. }: &RecordedEpisode) -> PathBuf {
    folder.join(&variation.task).join(format!("{episode_id}.{}", recording::EXTENSION))
}

/// Checks that a recording's path agrees with its header: task and id are taken from the path when tasks are held out and
/// episodes looked up.
fn check_place(folder: &Path, found: &Path, info: RecordedEpisode) -> anyhow::Result<RecordedEpisode> {
    let expected = path(folder, &info);
    ensure!(found == expected, "place: expected {}, got {}", expected.display(), found.display());
    Ok(info)
}

/// Reads a recording of a folder.
///
/// # Errors
/// If the file is damaged, or its path does not agree with its header.
pub fn read(folder: &Path, path: &Path) -> anyhow::Result<Episode> {
    let read = || {
        let episode = recording::read(path)?;
        check_place(folder, path, episode.info().clone())?;
        anyhow::Ok(episode)
    };
    read().with_context(|| path.display().to_string())
}

/// Names of the tasks of a folder, ordered.
///
/// # Errors
/// If the folder cannot be read.
pub fn tasks(folder: &Path) -> anyhow::Result<Vec<String>> {
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    Ok(files::list(folder)?.iter().filter(|path| path.is_dir()).map(name).collect())
}

/// Paths of the recordings of a folder, ordered by task and name.
///
/// # Errors
/// If the folder cannot be read.
pub fn paths(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut paths = Vec::new();
    for task in tasks(folder)? {
        let found = files::list(&folder.join(task))?;
        paths.extend(found.into_iter().filter(|path| path.extension().is_some_and(|e| e == recording::EXTENSION)));
    }
    Ok(paths)
}

/// Faults of recordings with the id, which is the file's name, of an earlier one.
pub(crate) fn duplicates(paths: &[PathBuf]) -> Vec<String> {
    let mut seen = HashMap::new();
    let duplicate = |path: &PathBuf| {
        let first = seen.insert(path.file_name()?.to_owned(), path.clone())?;
        let (path, first) = (path.display(), first.display());
        Some(format!("{path}: expected an id that no other episode has, got that of {first}"))
    };
    paths.iter().filter_map(duplicate).collect()
}

/// Digest of a dataset: SHA-256, in hex, over the metadata of each episode, which has its digest and render spec, in the order
/// of [`paths`]. It does not depend on the files' compression.
pub fn dataset_digest<'a>(episodes: impl IntoIterator<Item = &'a RecordedEpisode>) -> String {
    let mut hasher = Sha256::new();
    for episode in episodes {
        hasher.update(format!("{} {:?}\n", episode.episode_id, fields(episode)));
    }
    hex::encode(hasher.finalize())
}
