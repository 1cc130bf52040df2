//! Journal of a run in its folder: `progress.jsonl`, a TensorBoard event file with the same values, and `curve.svg`.

use crate::training::curve;
use crate::training::progress::{Observer, Progress, ends_epoch};
use crate::training::run;
use crate::training::tensorboard::EventWriter;
use anyhow::{Context, ensure};
use serde::{Deserialize, Serialize};
use service_kit::files;
use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Maximum number of noted steps, besides the last of each epoch.
const MAX_NOTED: u64 = 1000;
/// Name of the file with one line per noted step.
const PROGRESS: &str = "progress.jsonl";
/// Prefix of TensorBoard's file names.
const EVENTS: &str = "events.out.tfevents.";
/// Name of the file with the path of the run's checkpoint, which marks the owner of the folder.
const OWNER: &str = "checkpoint.txt";

/// A line of `progress.jsonl`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// Time of the step's end, in seconds since the Unix epoch.
    pub unix_seconds: f64,
    /// Progress after the step.
    #[serde(flatten)]
    pub progress: Progress,
}

/// Observer that notes a run's progress in its folder. Events and curve are derived from the lines of `progress.jsonl`.
#[derive(Debug)]
pub struct Journal {
    folder: PathBuf,
    name: String,
    /// Lock of the folder, so that two processes do not note different parts.
    _lock: File,
    entries: Vec<Entry>,
    files: Option<OpenFiles>,
}

/// Files that are appended to.
#[derive(Debug)]
struct OpenFiles {
    lines: File,
    events: EventWriter<File>,
}

impl Journal {
    /// Opens the journal in a folder, for the run that writes `checkpoint`.
    ///
    /// # Errors
    /// If the folder cannot be created, is locked by another process, or is owned by a run with another checkpoint.
    pub fn open(folder: PathBuf, checkpoint: &Path) -> anyhow::Result<Self> {
        let lock = files::take_over(&folder).context("run_dir")?;
        files::remove_unfinished(&folder)?;
        own(&folder, &std::path::absolute(checkpoint)?)?;
        let name = checkpoint.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self { folder, name, _lock: lock, entries: Vec::new(), files: None })
    }

    fn draw(&self) -> anyhow::Result<()> {
        files::write_atomically(&self.folder.join("curve.svg"), curve::draw(&self.name, &self.entries)?.as_bytes())
    }
}

impl Observer for Journal {
    /// Drops the entries of steps that will be repeated.
    fn begin(&mut self, step: u64) -> anyhow::Result<()> {
        self.entries = read(&self.folder)?;
        self.entries.retain(|entry| entry.progress.step <= step);
        let path = self.folder.join(PROGRESS);
        let lines = self.entries.iter().map(line).collect::<serde_json::Result<Vec<_>>>()?;
        files::write_atomically(&path, &lines.concat())?;
        let lines = OpenOptions::new().append(true).open(&path).with_context(|| path.display().to_string())?;
        self.files = Some(OpenFiles { lines, events: begin_events(&self.folder, &self.entries)? });
        Ok(())
    }

    fn observe(&mut self, progress: &Progress) -> anyhow::Result<()> {
        let every = progress.steps.div_ceil(MAX_NOTED);
        if !progress.step.is_multiple_of(every) && !ends_epoch(progress) {
            return Ok(());
        }
        let entry = Entry { unix_seconds: unix_seconds(), progress: *progress };
        let files = self.files.as_mut().context("a journal that has begun")?;
        files.lines.write_all(&line(&entry)?).with_context(|| self.folder.join(PROGRESS).display().to_string())?;
        write_events(&mut files.events, &entry)?;
        self.entries.push(entry);
        if ends_epoch(progress) { self.draw() } else { Ok(()) }
    }
}

/// Marks the run as owner of the folder. A folder of another run is refused, so that its curve is not overwritten, unless neither
/// the checkpoint nor the saved state of that run exists at its path any more.
fn own(folder: &Path, checkpoint: &Path) -> anyhow::Result<()> {
    let path = folder.join(OWNER);
    let owner = match std::fs::read(&path) {
        Err(error) if error.kind() == ErrorKind::NotFound => PathBuf::new(),
        owner => PathBuf::from(OsString::from_vec(owner.with_context(|| path.display().to_string())?)),
    };
    if owner == checkpoint {
        return Ok(());
    }
    ensure!(
        !owner.exists() && !owner.with_extension(run::RESUME).exists(),
        "run_dir: expected a folder of {}, got {}, which is that of {}: give each run its own",
        checkpoint.display(),
        folder.display(),
        owner.display()
    );
    files::write_atomically(&path, checkpoint.as_os_str().as_bytes())
}

/// Reads the entries of a folder, up to the first line that is malformed, as after a crash; none if the file does not exist.
///
/// # Errors
/// If the file exists and cannot be read.
pub fn read(folder: &Path) -> anyhow::Result<Vec<Entry>> {
    let path = folder.join(PROGRESS);
    match std::fs::read_to_string(&path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Vec::new()),
        text => Ok(text
            .with_context(|| path.display().to_string())?
            .lines()
            .map_while(|line| serde_json::from_str(line).ok())
            .collect()),
    }
}

fn line(entry: &Entry) -> serde_json::Result<Vec<u8>> {
    let mut line = serde_json::to_vec(entry)?;
    line.push(b'\n');
    Ok(line)
}

/// Creates an event file with the entries, and removes the previous ones.
fn begin_events(folder: &Path, entries: &[Entry]) -> anyhow::Result<EventWriter<File>> {
    let mut old = files::list(folder)?;
    old.retain(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(EVENTS)));
    // Names increase, so that a running TensorBoard continues with the new file.
    let path = folder.join(format!("{EVENTS}{:.6}.{}", unix_seconds(), std::process::id()));
    let mut events = EventWriter::new(File::create_new(&path)?, unix_seconds())?;
    for entry in entries {
        write_events(&mut events, entry)?;
    }
    for file in old {
        std::fs::remove_file(file)?;
    }
    Ok(events)
}

fn write_events(events: &mut EventWriter<File>, entry: &Entry) -> anyhow::Result<()> {
    let Progress { step, loss, learning_rate, gradient_norm, samples_per_second, .. } = entry.progress;
    let scalars = [
        ("train/loss", loss as f32),
        ("train/learning_rate", learning_rate as f32),
        ("train/gradient_norm", gradient_norm as f32),
        ("train/samples_per_second", samples_per_second as f32),
    ];
    Ok(events.write_scalars(i64::try_from(step)?, entry.unix_seconds, &scalars)?)
}

fn unix_seconds() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}
