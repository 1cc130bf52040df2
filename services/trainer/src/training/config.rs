//! What a training run can be told.

use anyhow::{Context, ensure};
use cpn::{ModelConfig, Preset, Recipe, Training};
use engines::{Device, EngineKind};
use figment::Figment;
use figment::providers::{Format, Serialized, Toml};
use figment::value::Value;
use serde::{Deserialize, Serialize};
use service_kit::config;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// How the names of environment variables begin.
const PREFIX: &str = "CPN_TRAIN_";
/// Settings that are text, whatever they look like.
const TEXTS: [&str; 6] = ["preset", "dataset", "out", "run_dir", "engine", "device"];
/// Most threads of a run: more than any machine has to gain from.
const MAX_THREADS: usize = 1024;
/// Settings of a run, by their names.
const FIELDS: [&str; 12] = [
    "preset",
    "model",
    "training",
    "dataset",
    "out",
    "hold_out",
    "seed",
    "engine",
    "device",
    "threads",
    "save_interval_seconds",
    "run_dir",
];

/// Valid settings of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Where model and training come from, as far as nothing else is said of them.
    pub preset: Preset,
    /// What is trained.
    pub model: ModelConfig,
    /// How.
    pub training: Training,
    /// Folder of the demonstrations.
    pub dataset: PathBuf,
    /// Where the checkpoint goes.
    pub out: PathBuf,
    /// Tasks that the model must not see.
    pub hold_out: Vec<String>,
    /// Seed of initialisation and sampling.
    pub seed: u64,
    /// Engine that computes; none for the device's own: native on the CPU, torch on a CUDA device.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub engine: Option<EngineKind>,
    /// Device that computes.
    pub device: Device,
    /// Number of threads that compute on the CPU. The order of sums depends on their number, and with it the last bits of the weights.
    pub threads: usize,
    /// How often the run saves its state; 0 is after each step.
    pub save_interval_seconds: f64,
    /// Where the run keeps its progress, events and curve; `runs/training/` and the stem of `out` if none is given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub run_dir: Option<PathBuf>,
}

impl From<Preset> for Config {
    fn from(preset: Preset) -> Self {
        let Recipe { model, training } = preset.recipe();
        Self {
            preset,
            model,
            training,
            dataset: "data/demonstrations".into(),
            out: format!("runs/checkpoints/{}.safetensors", preset.name()).into(),
            hold_out: Vec::new(),
            seed: 0,
            engine: None,
            device: Device::Cpu,
            threads: 1,
            save_interval_seconds: 60.0,
            run_dir: None,
        }
    }
}

/// The value of a setting that is written as text. What lies below `model` and `training` says its type itself, since it may
/// be of one kind or another; the others are told by their names.
fn value(key: &str, text: &str) -> Value {
    if TEXTS.contains(&key) {
        return Value::from(text);
    }
    // Figment's own reading of text knows neither exponents nor that a decimal fraction needs 64 bits.
    let value =
        toml::from_str::<toml::Table>(&format!("value = {text}")).ok().and_then(|mut table| table.remove("value"));
    value.and_then(|value| Value::serialize(value).ok()).unwrap_or_else(|| Value::from(text))
}

impl Config {
    /// Reads settings in layers: `changes`, each `key=value`, over what was typed over the environment over a file over the
    /// preset, which any of them may name.
    ///
    /// # Errors
    /// Names the field, what was expected and what came.
    pub fn load(file: Option<&Path>, arguments: &impl Serialize, changes: &[String]) -> anyhow::Result<Self> {
        let mut layers = Figment::new();
        if let Some(file) = file {
            layers = layers.merge(Toml::file_exact(file));
        }
        for variable in config::variables(PREFIX, &FIELDS, value, config::environment())? {
            layers = layers.merge(variable);
        }
        layers = layers.merge(Serialized::defaults(arguments));
        for change in changes {
            let (key, text) = change.split_once('=').with_context(|| format!("expected key=value, got {change:?}"))?;
            layers = layers.merge((key, value(key, text)));
        }
        Self::over_preset(layers)
    }

    /// Reads settings as they stand in a file.
    ///
    /// # Errors
    /// Names the field, what was expected and what came.
    pub fn from_toml(text: &str) -> anyhow::Result<Self> {
        Self::over_preset(Figment::from(Toml::string(text)))
    }

    /// The settings of the preset that some settings name, and these over them.
    fn over_preset(settings: Figment) -> anyhow::Result<Self> {
        let preset = if settings.contains("preset") { settings.extract_inner("preset")? } else { Preset::Cpn };
        let config: Self = Figment::from(Serialized::defaults(Self::from(preset))).merge(settings).extract()?;
        config.validate()?;
        Ok(config)
    }

    /// Checks what can be checked before anything is read.
    ///
    /// # Errors
    /// Names the field, what was expected and what came.
    pub fn validate(&self) -> anyhow::Result<()> {
        self.recipe().validate()?;
        let threads = self.threads;
        ensure!((1..=MAX_THREADS).contains(&threads), "threads: expected 1 to {MAX_THREADS}, got {threads}");
        let seconds = self.save_interval_seconds;
        ensure!(
            Duration::try_from_secs_f64(seconds).is_ok(),
            "save_interval_seconds: expected a number of seconds from 0 on, got {seconds:?}"
        );
        ensure!(
            self.out.file_name().is_some(),
            "out: expected the path of a file, got {:?}",
            self.out.display().to_string()
        );
        for (index, task) in self.hold_out.iter().enumerate() {
            let known = self.hold_out[..index].contains(task);
            ensure!(!task.is_empty() && !known, "hold_out: expected tasks, each once, got {:?}", self.hold_out);
        }
        Ok(())
    }

    /// The run's name: the stem of its checkpoint's file.
    pub fn name(&self) -> String {
        self.out.file_stem().unwrap_or_default().to_string_lossy().into_owned()
    }

    /// Where the run keeps its progress, events and curve.
    pub fn run_dir(&self) -> PathBuf {
        self.run_dir.clone().unwrap_or_else(|| Path::new("runs/training").join(self.name()))
    }

    /// What is trained, and how.
    pub fn recipe(&self) -> Recipe {
        Recipe { model: self.model.clone(), training: self.training.clone() }
    }
}
