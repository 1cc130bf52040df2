//! Records of a run in its folder: one file that describes it, and one for each trial.

use crate::control::Control;
use crate::planning::Planning;
use anyhow::{Context, ensure};
use recording::trial::{self, Recording};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize};
use service_kit::files::{self, write_atomically};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use wire::planner::ModelInfo;

/// Version of the files; another one is refused.
pub const FORMAT: u32 = 2;

/// Seeds below this one are those of demonstrations.
pub(crate) const FIRST_EVALUATION_SEED: u64 = 1_000_000;

/// Description of a run: its models, tasks and settings.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Run {
    /// [`FORMAT`].
    pub format: u32,
    /// Title of the report.
    pub title: String,
    /// The command line.
    pub command: String,
    /// When it was started, RFC 3339.
    pub date: String,
    /// Names of the planners; runs of a single planner were once recorded as `planner`.
    #[serde(alias = "planner", deserialize_with = "one_or_many")]
    pub planners: Vec<String>,
    /// The compared models, in the order of the command line.
    pub models: Vec<Model>,
    /// The tasks, in the order of the command line.
    pub tasks: Vec<String>,
    /// Variations of each task.
    pub trials: u32,
    /// Seed of the first variation.
    pub first_seed: u64,
    /// Source of the goals.
    pub goal: GoalSource,
    /// Settings of plans in closed loop.
    #[serde(default = "Planning::of_old_record")]
    pub planning: Planning,
}

impl Run {
    /// Whether its variations are, at least in part, those that demonstrations show.
    pub fn has_demonstration_seeds(&self) -> bool {
        self.first_seed < FIRST_EVALUATION_SEED
    }
}

/// A list, or a single name in place of one.
fn one_or_many<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<String>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Names {
        One(String),
        Many(Vec<String>),
    }
    Ok(match Names::deserialize(deserializer)? {
        Names::One(name) => vec![name],
        Names::Many(names) => names,
    })
}

/// Which variation's end the goal shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum GoalSource {
    /// That of the variation to be solved.
    SameVariation,
    /// That of the next seed's, an ablation: what a method can do with a picture of the task but not of this scene.
    OtherVariation,
}

/// A model as the planner served it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Model {
    /// Name it is served under.
    pub name: String,
    /// `random`, `bc`, `te-bc`, `te-bc-horizon`, `upn` or `cpn`; `no-op` or `oracle` for a control of the evaluator's own.
    pub method: String,
    /// SHA-256 of its checkpoint, in hex; empty for a control of the evaluator's own.
    pub digest: String,
    /// Tasks it was trained on.
    pub training_tasks: Vec<String>,
    /// Number of actions in a plan.
    pub horizon: u32,
}

impl Model {
    /// Whether its actions come from a search, which a request may choose.
    pub(crate) fn plans(&self) -> bool {
        matches!(self.method.as_str(), "upn" | "cpn")
    }

    /// Whether it stands beside the trained models as a control.
    pub(crate) fn is_control(&self) -> bool {
        self.method == "random" || Control::of(self).is_some()
    }
}

impl From<ModelInfo> for Model {
    fn from(info: ModelInfo) -> Self {
        let ModelInfo { name, method, digest, training_tasks, horizon, version: _ } = info;
        Self { name, method, digest, training_tasks, horizon }
    }
}

/// One first attempt of one model at one variation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// [`FORMAT`].
    pub format: u32,
    /// The variation's task.
    pub task: String,
    /// The variation's seed.
    pub seed: u64,
    /// Name of the model.
    pub model: String,
    /// SHA-256 of its checkpoint, in hex.
    pub model_digest: String,
    /// Source of the goal.
    pub goal: GoalSource,
    /// Settings of plans in closed loop.
    #[serde(default = "Planning::of_old_record")]
    pub planning: Planning,
    /// Outcome.
    #[serde(flatten)]
    pub outcome: Outcome,
    /// The episode; none if there was no attempt, and after an error.
    pub episode: Option<Episode>,
}

/// Outcome of a trial.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "outcome", rename_all = "lowercase")]
pub enum Outcome {
    /// The task was solved.
    Success,
    /// The steps ran out.
    Failure,
    /// The task was solved before any action, so that nothing was attempted.
    #[serde(rename = "solved-at-reset")]
    SolvedAtReset,
    /// The trial was not brought to an end, which says nothing about the model.
    Error {
        /// Message of the error.
        message: String,
    },
}

/// The course of an episode. A number that is not finite is recorded as none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Episode {
    /// Id of the goal: SHA-256 of the image or position, in hex.
    pub goal_id: String,
    /// Actions applied.
    pub steps: u32,
    /// Progress towards success before the first step and after each, 0 to 1, as the simulator measures it; empty in records
    /// from before it was measured.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub progress: Vec<f64>,
    /// Steps before each plan; empty if there was a plan before every step, or none at all.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub plan_steps: Vec<u32>,
    /// Distance between the embeddings of observation and goal at each plan; empty for a method without embedding.
    pub latent_distances: Vec<Option<f32>>,
    /// Inner loss before each update and after the last, of the first plan.
    pub first_inner_losses: Vec<Option<f32>>,
    /// The same of the last plan.
    pub last_inner_losses: Vec<Option<f32>>,
    /// Stage times of the planner.
    pub mean_times: StageTimes,
}

/// Stage times of the planner, mean over the plans of an episode.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct StageTimes {
    /// Waiting for the model.
    pub queue_seconds: f64,
    /// Embedding the observation and, if it was not cached, the goal.
    pub encode_seconds: f64,
    /// Planning.
    pub plan_seconds: f64,
}

impl Episode {
    /// The step before which each plan was asked for.
    pub(crate) fn plan_step(&self, plan: usize) -> u32 {
        self.plan_steps.get(plan).copied().unwrap_or(plan as u32)
    }
}

/// The folder of a run.
#[derive(Debug, Clone)]
pub struct Folder {
    root: PathBuf,
}

impl Folder {
    /// Makes the folder, if there is none, and takes it over for as long as the answer lives: what a run reports is what is
    /// in it.
    pub(crate) fn take_over(&self) -> anyhow::Result<File> {
        files::take_over(&self.root).context("--out")
    }

    /// The folder at a path, which need not exist.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }

    /// Path of a file or folder of the run.
    pub fn path(&self, name: &str) -> PathBuf {
        self.root.join(name)
    }

    /// Writes what the run is.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write_run(&self, run: &Run) -> anyhow::Result<()> {
        write_json(&self.path("run.json"), run)
    }

    /// Checks that the folder is free for a run with such goals and plans: trials lie in it by model and variation, so that
    /// those with others would take their place.
    pub(crate) fn check_settings(&self, goal: GoalSource, planning: &Planning) -> anyhow::Result<()> {
        if self.path("run.json").exists() {
            let got = self.read_run()?;
            let folder = self.root.display();
            let (expected, found) = (serde_json::to_string(&goal)?, serde_json::to_string(&got.goal)?);
            ensure!(got.goal == goal, "--out: expected a folder of --goal {expected}, got {folder} of {found}");
            let found = got.planning;
            ensure!(found == *planning, "--out: expected a folder of {planning}, got {folder} of {found}");
        }
        Ok(())
    }

    /// Reads what the run is.
    pub(crate) fn read_run(&self) -> anyhow::Result<Run> {
        let path = self.path("run.json");
        let run: Run = read_json(&path).context("remove the file if it is damaged; `run` writes it anew")?;
        ensure!(run.format == FORMAT, "{}: expected format {FORMAT}, got {}", path.display(), run.format);
        Ok(run)
    }

    /// Writes a trial over any earlier one of the same model and variation.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write_trial(&self, trial: &Trial) -> anyhow::Result<()> {
        write_json(&self.trial_path(&trial.task, &trial.model, trial.seed), trial)
    }

    /// Writes the recording of a trial beside its record, over any earlier one.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write_recording(&self, recording: &Recording) -> anyhow::Result<()> {
        let trial = recording.trial();
        let record = self.trial_path(&trial.variation.task, &trial.model, trial.variation.seed);
        write_atomically(&record.with_extension(recording::EXTENSION), &trial::to_bytes(recording)?)
    }

    /// Reads the recording of a trial.
    pub(crate) fn read_recording(&self, trial: &Trial) -> anyhow::Result<Recording> {
        let record = self.trial_path(&trial.task, &trial.model, trial.seed);
        read_recording(&record.with_extension(recording::EXTENSION))
    }

    /// Remembers that a variation has no goal image: it is left out for all models.
    pub(crate) fn skip(&self, task: &str, seed: u64) -> anyhow::Result<()> {
        write_atomically(&self.root.join("skipped").join(task).join(seed.to_string()), &[])
    }

    /// The seeds of a task that are left out.
    pub(crate) fn skipped(&self, task: &str) -> anyhow::Result<BTreeSet<u64>> {
        Ok(file_names(&self.root.join("skipped").join(task))?.iter().filter_map(|name| name.parse().ok()).collect())
    }

    /// The run's trials that the folder holds: of its models with their present digests, at most `run.trials` seeds of
    /// each task. Ordered by task, seed and model. Records that are damaged, or of another trial than where they lie, are left
    /// out, each with a line in the log; `run` writes them anew.
    ///
    /// # Errors
    /// If a file cannot be read, or is of another format.
    pub fn trials(&self, run: &Run) -> anyhow::Result<Vec<Trial>> {
        let mut selected = Vec::new();
        for task in &run.tasks {
            let skipped = self.skipped(task)?;
            let mut by_seed: BTreeMap<u64, Vec<Trial>> = BTreeMap::new();
            for model in &run.models {
                let seeds = self.seeds(task, &model.name)?;
                for seed in seeds.range(run.first_seed..).filter(|seed| !skipped.contains(seed)) {
                    let Some(trial) = self.read_trial(task, &model.name, *seed)? else { continue };
                    if trial.model_digest == model.digest && trial.goal == run.goal && trial.planning == run.planning {
                        by_seed.entry(*seed).or_default().push(trial);
                    }
                }
            }
            selected.extend(by_seed.into_values().take(run.trials as usize).flatten());
        }
        Ok(selected)
    }

    /// The trial of a place; none if the record is damaged, or says that it is of another.
    fn read_trial(&self, task: &str, model: &str, seed: u64) -> anyhow::Result<Option<Trial>> {
        #[derive(Deserialize)]
        struct Header {
            format: u32,
        }
        let path = self.trial_path(task, model, seed);
        let bytes = fs::read(&path).with_context(|| format!("reading {}", path.display()))?;
        let left_out = |reason: String| {
            tracing::warn!("{}: {reason}; left out until the trial is run again", path.display());
            Ok(None)
        };

        if let Ok(Header { format }) = serde_json::from_slice(&bytes) {
            ensure!(format == FORMAT, "{}: expected format {FORMAT}, got {format}", path.display());
        }
        let trial: Trial = match serde_json::from_slice(&bytes) {
            Ok(trial) => trial,
            Err(error) => return left_out(format!("expected the record of a trial, got {error}")),
        };
        let place = |task: &str, model: &str, seed: u64| format!("{task} {seed}, {model}");
        let (expected, got) = (place(task, model, seed), place(&trial.task, &trial.model, trial.seed));
        if expected != got {
            return left_out(format!("expected the record of {expected}, got that of {got}"));
        }
        Ok(Some(trial))
    }

    fn trial_path(&self, task: &str, model: &str, seed: u64) -> PathBuf {
        self.root.join("trials").join(task).join(model).join(format!("{seed}.json"))
    }

    /// The seeds with a record.
    fn seeds(&self, task: &str, model: &str) -> anyhow::Result<BTreeSet<u64>> {
        let folder = self.root.join("trials").join(task).join(model);
        let names = file_names(&folder)?;
        Ok(names.iter().filter_map(|name| name.strip_suffix(".json")?.parse().ok()).collect())
    }
}

/// The names in a folder of the run; none if there is no such folder yet.
fn file_names(folder: &Path) -> anyhow::Result<Vec<String>> {
    if !folder.try_exists().with_context(|| folder.display().to_string())? {
        return Ok(Vec::new());
    }
    let name = |path: PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    Ok(files::list(folder)?.into_iter().map(name).collect())
}

/// Reads the recording of a trial.
pub(crate) fn read_recording(path: &Path) -> anyhow::Result<Recording> {
    let remedy = "remove the trial's record and run it again";
    trial::read(path).with_context(|| format!("{}: expected the recording of a trial; {remedy}", path.display()))
}

pub(crate) fn write_json<T: Serialize>(path: &Path, value: &T) -> anyhow::Result<()> {
    write_atomically(path, &serde_json::to_vec_pretty(value)?)
}

fn read_json<T: DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    let bytes = fs::read(path).with_context(|| format!("reading {}", path.display()))?;
    serde_json::from_slice(&bytes).with_context(|| format!("reading {}", path.display()))
}
