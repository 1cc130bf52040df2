//! Registry of training runs, without transports: starts them as processes, stops, lists and watches them.
//!
//! A run has a folder with its settings, state, log and [`crate::training::journal`]. The state outlasts the service: a run in
//! progress when the service ended is interrupted, and resumes from its last saved state when started again.

use crate::runs::process::{self, End};
use crate::training::{config, journal};
use futures::{Stream, stream};
use serde::{Deserialize, Serialize};
use service_kit::files;
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tracing::{info, warn};
use wire::training::{MAX_RUNS, Run, RunState, StartRunRequest};
use wire::{Code, Error};

/// Name of the file with a run's state.
const STATE: &str = "run.json";
/// Name of the file with a run's settings.
const SETTINGS: &str = "settings.toml";
/// Name of the file with a run's log.
const LOG: &str = "log.txt";

/// Folders and limits of training runs.
#[derive(Debug, Clone)]
pub struct Config {
    /// Folder with a folder for each run.
    pub folder: PathBuf,
    /// Folder of the recorded demonstrations.
    pub dataset: PathBuf,
    /// Folder of the checkpoints.
    pub checkpoints: PathBuf,
    /// Maximum number of concurrent runs.
    pub max_runs: usize,
    /// Path of `cpn-trainer`.
    pub program: PathBuf,
}

/// Registry of training runs. Clones share it.
#[derive(Debug, Clone)]
pub struct Runs {
    config: Arc<Config>,
    /// Lock of the folder, held until shutdown: with two services, each would know only a part of the runs.
    lock: Arc<Mutex<Option<File>>>,
    runs: watch::Sender<BTreeMap<String, Run>>,
    /// Stop tokens of the running runs, by name.
    stops: Arc<Mutex<HashMap<String, CancellationToken>>>,
    shutdown: CancellationToken,
    tasks: TaskTracker,
}

/// Persistent state of a run.
#[derive(Debug, Serialize, Deserialize)]
struct Kept {
    settings: toml::Table,
    run: Run,
}

impl Runs {
    /// Opens and locks a folder, and reads the states of its runs.
    ///
    /// # Errors
    /// If the folder cannot be created or read, or another process has it.
    pub fn open(config: Config) -> anyhow::Result<Self> {
        let lock = files::take_over(&config.folder)?;
        let mut runs = BTreeMap::new();
        for folder in files::list(&config.folder)? {
            match load(&folder) {
                Ok(Some(Kept { run, .. })) => drop(runs.insert(run.name.clone(), run)),
                Ok(None) => {}
                Err(error) => warn!(folder = %folder.display(), error = format!("{error:#}"), "run passed over"),
            }
        }
        Ok(Self {
            config: Arc::new(config),
            lock: Arc::new(Mutex::new(Some(lock))),
            runs: watch::Sender::new(runs),
            stops: Arc::default(),
            shutdown: CancellationToken::new(),
            tasks: TaskTracker::new(),
        })
    }

    /// Starts a run, or resumes one that stopped, failed or was interrupted. Blocks on files; requires a tokio runtime.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` if the settings are invalid; `FAILED_PRECONDITION` if the run is running or finished, or has other
    /// settings; `RESOURCE_EXHAUSTED` if the maximum number of concurrent runs, or of runs, is reached; `UNAVAILABLE` during
    /// shutdown; `INTERNAL` if a file cannot be written.
    pub fn start(&self, request: &StartRunRequest) -> Result<Run, Error> {
        let name = &request.name;
        let folder = self.config.folder.join(name);
        // Locked to the end, so that concurrent requests start a run once.
        let mut stops = self.stops();
        if self.shutdown.is_cancelled() {
            return Err(Error::new(Code::Unavailable, "service", "one that runs", "one that shuts down"));
        }

        self.forget_removed();
        let known = self.runs.borrow().get(name).cloned();
        if let Some(RunState::Running | RunState::Finished { .. }) = known.as_ref().map(|run| &run.state) {
            let got = known.map(|run| run.state.name()).unwrap_or_default();
            let expected = "the name of a run that is new, stopped, failed or interrupted";
            return Err(Error::new(Code::FailedPrecondition, "name", expected, format!("{name:?}, which is {got}")));
        }
        if known.is_none() && self.runs.borrow().len() >= MAX_RUNS {
            return Err(Error::new(Code::ResourceExhausted, "name", format!("at most {MAX_RUNS} runs"), "one more"));
        }
        if stops.len() >= self.config.max_runs {
            let running: Vec<_> = stops.keys().collect();
            let expected = format!("at most {} at a time", self.config.max_runs);
            return Err(Error::new(
                Code::ResourceExhausted,
                "max_runs",
                expected,
                format!("one more than {running:?}"),
            ));
        }

        let settings = self.settings(request, &folder)?;
        let progress = known.and_then(|run| run.progress);
        let run = Run { name: name.clone(), state: RunState::Running, progress };
        let text = settings_of_process(&self.config, &run.name, &settings);
        let write = || {
            files::write_atomically(&folder.join(SETTINGS), text.to_string().as_bytes())?;
            save(&folder, &Kept { settings: settings.clone(), run: run.clone() })
        };
        write().map_err(|error| Error::new(Code::Internal, "name", "a folder to write to", format!("{error:#}")))?;

        self.runs.send_modify(|runs| drop(runs.insert(name.clone(), run.clone())));
        let stop = self.shutdown.child_token();
        stops.insert(name.clone(), stop.clone());
        info!(run = name, "started");
        self.tasks.spawn(self.clone().supervise(run.clone(), settings, stop));
        Ok(run)
    }

    /// Stops a run, which saves its state, or is killed after half a minute.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown run; `FAILED_PRECONDITION` if it is not running.
    pub async fn stop(&self, name: &str) -> Result<Run, Error> {
        let mut runs = self.runs.subscribe();
        let state = self.get(name)?.state;
        match self.stops().get(name) {
            Some(stop) if state == RunState::Running => stop.cancel(),
            _ => {
                let got = format!("{name:?}, which is {}", state.name());
                return Err(Error::new(Code::FailedPrecondition, "name", "the name of a run that is running", got));
            }
        }

        let ended = |runs: &BTreeMap<String, Run>| runs.get(name).is_none_or(|run| run.state != RunState::Running);
        // Cannot fail, as this has the sender.
        let _ = runs.wait_for(ended).await;
        self.get(name)
    }

    /// All runs, ordered by name, without ended ones whose folders were removed.
    pub fn list(&self) -> Vec<Run> {
        self.forget_removed();
        self.runs.borrow().values().cloned().collect()
    }

    /// Stream of a run's states: the current one, then each change until it ends. A slow consumer gets only the latest.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown run.
    pub fn watch(&self, name: &str) -> Result<impl Stream<Item = Run> + Send + use<>, Error> {
        self.get(name)?;
        let start = Some((self.runs.subscribe(), name.to_owned(), None));
        Ok(stream::unfold(start, |state| async {
            let (mut runs, name, seen) = state?;
            let run = runs.wait_for(|runs| runs.get(&name) != seen.as_ref()).await.ok()?.get(&name)?.clone();
            let next = (run.state == RunState::Running).then(|| (runs, name, Some(run.clone())));
            Some((run, next))
        }))
    }

    /// Changes of all runs, beginning with their current states.
    pub(crate) fn changes(&self) -> Changes {
        let mut runs = self.runs.subscribe();
        runs.mark_changed();
        Changes { runs, seen: BTreeMap::new() }
    }

    /// Interrupts all runs, which can be resumed later, and refuses new ones.
    pub(crate) async fn shutdown(&self) {
        let running = {
            let _starting = self.stops();
            self.shutdown.cancel();
            self.tasks.close();
            self.tasks.len()
        };
        if running > 0 {
            info!(running, "stopping runs");
        }
        self.tasks.wait().await;
        drop(self.lock.lock().unwrap_or_else(PoisonError::into_inner).take());
    }

    /// Removes runs whose folders were deleted, so that they can be started anew.
    fn forget_removed(&self) {
        let is_there =
            |run: &Run| run.state == RunState::Running || self.config.folder.join(&run.name).join(STATE).exists();
        self.runs.send_if_modified(|runs| {
            let before = runs.len();
            runs.retain(|_, run| is_there(run));
            runs.len() < before
        });
    }

    fn get(&self, name: &str) -> Result<Run, Error> {
        let unknown = || Error::new(Code::NotFound, "name", "the name of a run", format!("{name:?}"));
        self.runs.borrow().get(name).cloned().ok_or_else(unknown)
    }

    /// Settings of a request or, if it has none, those of the existing run.
    fn settings(&self, request: &StartRunRequest, folder: &Path) -> Result<toml::Table, Error> {
        let settings = requested_settings(&self.config, request)?;
        let kept = load(folder).map_err(|e| Error::new(Code::Internal, "name", "a run", format!("{e:#}")))?;
        match kept.map(|kept| kept.settings) {
            Some(kept) if settings.is_empty() => Ok(kept),
            Some(kept) if kept != settings => {
                let line = |table: &toml::Table| table.to_string().trim().replace('\n', ", ");
                Err(Error::new(Code::FailedPrecondition, "settings", line(&kept), line(&settings)))
            }
            _ => Ok(settings),
        }
    }

    /// Runs a run's process to its end, and updates its state.
    async fn supervise(self, mut run: Run, settings: toml::Table, stop: CancellationToken) {
        let folder = self.config.folder.join(&run.name);
        let on_progress = |progress| {
            self.runs.send_modify(|runs| {
                if let Some(run) = runs.get_mut(&run.name) {
                    run.progress = Some(progress);
                }
            });
        };
        let (file, log) = (folder.join(SETTINGS), folder.join(LOG));
        let end = process::run(&self.config.program, &file, &log, &stop, on_progress).await;

        run.progress = self.get(&run.name).ok().and_then(|run| run.progress);
        run.state = match end {
            End::Finished { digest } => RunState::Finished { digest },
            End::Failed { reason } => RunState::Failed { reason },
            End::Saved | End::Killed if self.shutdown.is_cancelled() => RunState::Interrupted,
            End::Killed => RunState::Stopped,
            End::Saved if stop.is_cancelled() => RunState::Stopped,
            End::Saved => RunState::Interrupted,
        };
        info!(run = run.name, state = run.state.name(), "ended");

        let kept = Kept { settings, run: run.clone() };
        let written = tokio::task::spawn_blocking(move || save(&folder, &kept)).await;
        if let Err(error) = written.map_err(anyhow::Error::from).flatten() {
            warn!(error = format!("{error:#}"), "state of a run not written");
        }
        // The place is freed before the end is published, so that a client that sees it can start another run.
        self.stops().remove(&run.name);
        self.runs.send_modify(|runs| drop(runs.insert(run.name.clone(), run)));
    }

    fn stops(&self) -> MutexGuard<'_, HashMap<String, CancellationToken>> {
        self.stops.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Stream of changed runs.
#[derive(Debug)]
pub(crate) struct Changes {
    runs: watch::Receiver<BTreeMap<String, Run>>,
    seen: BTreeMap<String, Run>,
}

impl Changes {
    /// Waits for a change, and returns all changed runs; none once the registry is dropped.
    pub(crate) async fn next(&mut self) -> Option<Vec<Run>> {
        self.runs.changed().await.ok()?;
        let runs = self.runs.borrow_and_update().clone();
        let changed = runs.values().filter(|run| self.seen.get(&run.name) != Some(run)).cloned().collect();
        self.seen = runs;
        Some(changed)
    }
}

/// Reads the state in a run's folder; none if the folder is not one of a run.
fn load(folder: &Path) -> anyhow::Result<Option<Kept>> {
    let bytes = match std::fs::read(folder.join(STATE)) {
        Err(error) if [std::io::ErrorKind::NotFound, std::io::ErrorKind::NotADirectory].contains(&error.kind()) => {
            return Ok(None);
        }
        bytes => bytes?,
    };
    let mut kept: Kept = serde_json::from_slice(&bytes)?;
    if kept.run.state == RunState::Running {
        kept.run.state = RunState::Interrupted;
        kept.run.progress = journal::read(folder)?.last().map(|entry| entry.progress);
    }
    Ok(Some(kept))
}

fn save(folder: &Path, kept: &Kept) -> anyhow::Result<()> {
    files::write_atomically(&folder.join(STATE), &serde_json::to_vec_pretty(kept)?)
}

/// Validated settings of a request.
fn requested_settings(config: &Config, request: &StartRunRequest) -> Result<toml::Table, Error> {
    let StartRunRequest { name, preset, hold_out, seed, settings } = request;
    let mut table: toml::Table =
        toml::from_str(settings).map_err(|error| Error::invalid("settings", "TOML", error.message()))?;
    for field in process_settings(config, name).keys() {
        if let Some(value) = table.get(field) {
            return Err(Error::invalid(format!("settings.{field}"), "none: the service sets it", value));
        }
    }

    let hold_out = (!hold_out.is_empty()).then(|| hold_out.clone().into());
    let seed =
        seed.map(i64::try_from).transpose().map_err(|_| Error::invalid("seed", "less than 2^63", seed.unwrap_or(0)))?;
    let named: [(&str, Option<toml::Value>); 3] =
        [("preset", preset.clone().map(Into::into)), ("hold_out", hold_out), ("seed", seed.map(Into::into))];
    for (field, value) in named {
        if let Some(value) = value
            && let Some(twice) = table.insert(field.into(), value)
        {
            return Err(Error::invalid(format!("settings.{field}"), "a setting that is named once", twice));
        }
    }

    config::Config::from_toml(&settings_of_process(config, name, &table).to_string())
        .map_err(|error| Error::invalid("settings", "settings of a training run", format!("{error:#}")))?;
    Ok(table)
}

/// Settings that the service decides for a run.
fn process_settings(config: &Config, name: &str) -> toml::Table {
    let path = |path: PathBuf| toml::Value::from(path.to_string_lossy().into_owned());
    toml::Table::from_iter([
        ("dataset".to_owned(), path(config.dataset.clone())),
        ("out".to_owned(), path(config.checkpoints.join(format!("{name}.safetensors")))),
        ("run_dir".to_owned(), path(config.folder.join(name))),
    ])
}

/// All settings of a run's process.
fn settings_of_process(config: &Config, name: &str, settings: &toml::Table) -> toml::Table {
    let mut all = settings.clone();
    all.extend(process_settings(config, name));
    all
}
