//! A folder of recordings: `<task>/<episode id>.mcap`.

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

/// The recordings that one process keeps. What is said of them holds of the files on disk: one that was removed, cut or
/// replaced meanwhile is not taken for kept.
#[derive(Debug)]
pub struct Recordings {
    folder: PathBuf,
    /// Held as long as this lives.
    _lock: File,
    index: Mutex<Index>,
    /// Held from the check to the entry: two episodes of one id are never written both.
    writing: Mutex<()>,
}

/// The episodes that were whole when their files were read, by id.
#[derive(Debug, Default)]
struct Index(BTreeMap<String, Kept>);

/// A file that was read to its end.
#[derive(Debug, Clone)]
struct Kept {
    info: RecordedEpisode,
    stamp: Stamp,
}

/// Tells apart what a file was before and after it was written: its inode, size, and when it changed.
type Stamp = (u64, u64, i64, i64);

fn stamp(path: &Path) -> std::io::Result<Stamp> {
    let metadata = path.metadata()?;
    Ok((metadata.ino(), metadata.len(), metadata.ctime(), metadata.ctime_nsec()))
}

impl Kept {
    /// Reads a recording to its end.
    fn read(folder: &Path, found: &Path) -> anyhow::Result<Self> {
        // If the file is replaced while it is read, it is read once more.
        let stamp = stamp(found)?;
        let info = read(folder, found)?.info().clone();
        Ok(Self { info, stamp })
    }
}

impl Index {
    /// A kept episode; what is not on disk any more as it was read is read again, or forgotten.
    fn get(&mut self, folder: &Path, episode_id: &str) -> Option<&RecordedEpisode> {
        let Kept { info, stamp: known } = self.0.get(episode_id)?;
        let path = path(folder, info);
        if stamp(&path).ok() != Some(*known) {
            self.take_in(folder, episode_id, &path);
        }
        self.0.get(episode_id).map(|kept| &kept.info)
    }

    /// Looks at the place of an episode, whose file may have come, gone or changed.
    fn take_in(&mut self, folder: &Path, episode_id: &str, path: &Path) {
        match Kept::read(folder, path) {
            Ok(kept) => drop(self.0.insert(episode_id.to_owned(), kept)),
            Err(error) => {
                if self.0.remove(episode_id).is_some() {
                    warn!(episode_id, error = format!("{error:#}"), "not kept any more");
                }
            }
        }
    }

    /// Every kept episode, by id.
    fn all(&mut self, folder: &Path) -> Vec<RecordedEpisode> {
        let ids: Vec<_> = self.0.keys().cloned().collect();
        ids.iter().filter_map(|id| self.get(folder, id).cloned()).collect()
    }

    /// Of every episode; none before the first.
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
    /// Takes over a folder: removes what a killed process left unfinished and reads every recording, on every core. A file
    /// that is no whole recording is passed over; when its episode comes again, it takes the file's place.
    ///
    /// # Errors
    /// If the folder cannot be made or read, another process has it, or its recordings differ in their render spec.
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

    /// Whether an episode was kept when it was last asked for; the disk is not looked at.
    pub fn contains(&self, episode_id: &str) -> bool {
        self.index().0.contains_key(episode_id)
    }

    /// What is known of a kept episode.
    pub fn get(&self, episode_id: &str) -> Option<RecordedEpisode> {
        self.index().get(&self.folder, episode_id).cloned()
    }

    /// How many episodes are kept.
    pub fn count(&self) -> usize {
        self.all().len()
    }

    /// Every kept episode, by id.
    pub fn all(&self) -> Vec<RecordedEpisode> {
        self.index().all(&self.folder)
    }

    /// Whether an episode is still to be kept; if not, the same one is kept already.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if another one is kept under its id, or it was rendered otherwise than those that are kept.
    pub fn lacks(&self, offered: &RecordedEpisode) -> Result<bool, Error> {
        let mut index = self.index();
        let refused =
            |field, expected: &str, got: &str| Err(Error::new(Code::FailedPrecondition, field, expected, got));
        if !index.0.contains_key(&offered.episode_id) {
            // Somebody may have put it there.
            let path = path(&self.folder, offered);
            if path.exists() {
                index.take_in(&self.folder, &offered.episode_id, &path);
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
        let write = || {
            files::write_atomically(&path, &recording::to_bytes(episode)?)?;
            anyhow::Ok(stamp(&path)?)
        };
        let stamp =
            write().map_err(|e| Error::new(Code::Internal, "episode_id", "a kept episode", format!("{e:#}")))?;
        self.index().0.insert(info.episode_id.clone(), Kept { info: info.clone(), stamp });
        Ok(())
    }

    /// Reads a kept episode; none if there is no such.
    ///
    /// # Errors
    /// `INTERNAL` if its file is damaged; it is not taken for kept from then on.
    pub fn read(&self, episode_id: &str) -> Result<Option<Episode>, Error> {
        let Some(info) = self.get(episode_id) else { return Ok(None) };
        let path = path(&self.folder, &info);
        read(&self.folder, &path).map(Some).map_err(|e| {
            self.index().take_in(&self.folder, episode_id, &path);
            Error::new(Code::Internal, "episode_id", "a whole recording", format!("{e:#}"))
        })
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
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    Ok(files::list(folder)?.iter().filter(|path| path.is_dir()).map(name).collect())
}

/// The recordings of a folder, in order of task and name.
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

/// The recordings whose names, which are their episodes' ids, are those of others before.
pub(crate) fn duplicates(paths: &[PathBuf]) -> Vec<String> {
    let mut seen = HashMap::new();
    let duplicate = |path: &PathBuf| {
        let first = seen.insert(path.file_name()?.to_owned(), path.clone())?;
        let (path, first) = (path.display(), first.display());
        Some(format!("{path}: expected an id that no other episode has, got that of {first}"))
    };
    paths.iter().filter_map(duplicate).collect()
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
