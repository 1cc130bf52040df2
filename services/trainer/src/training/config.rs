//! Settings of a training run.

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

/// Prefix of environment variables.
const PREFIX: &str = "CPN_TRAIN_";
/// Settings with values of text, even if they look like numbers.
const TEXTS: [&str; 6] = ["preset", "dataset", "out", "run_dir", "engine", "device"];
/// Maximum number of threads: more than any machine can use.
const MAX_THREADS: usize = 1024;
/// Names of the settings.
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
    /// Preset, with the default of model and training.
    pub preset: Preset,
    /// Model configuration.
    pub model: ModelConfig,
    /// Training settings.
    pub training: Training,
    /// Folder of the demonstrations.
    pub dataset: PathBuf,
    /// File of the checkpoint.
    pub out: PathBuf,
    /// Tasks held out of the training.
    pub hold_out: Vec<String>,
    /// Seed of initialisation and sampling.
    pub seed: u64,
    /// Engine; by default native on the CPU, and torch on a CUDA device.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub engine: Option<EngineKind>,
    /// Device.
    pub device: Device,
    /// Number of threads on the CPU. It determines the order of sums, and with it the last bits of the weights.
    pub threads: usize,
    /// Interval between saved states, in seconds; 0 saves after each step.
    pub save_interval_seconds: f64,
    /// Folder of progress, events and curve; by default `runs/training/` and the stem of `out`.
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

/// Parses the value of a setting. Settings of text are recognised by name; the values of all others are TOML, or else text.
fn value(key: &str, text: &str) -> Value {
    if TEXTS.contains(&key) {
        return Value::from(text);
    }
    // Figment's own parser lacks exponents, and reads decimal fractions with 32 bits.
    let value =
        toml::from_str::<toml::Table>(&format!("value = {text}")).ok().and_then(|mut table| table.remove("value"));
    value.and_then(|value| Value::serialize(value).ok()).unwrap_or_else(|| Value::from(text))
}

impl Config {
    /// Reads settings in layers of increasing precedence: preset, file, environment, command-line arguments, and `changes`, each
    /// `key=value`. Any layer may name the preset.
    ///
    /// # Errors
    /// The invalid field, with the expected and the given value.
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

    /// Reads settings from TOML.
    ///
    /// # Errors
    /// The invalid field, with the expected and the given value.
    pub fn from_toml(text: &str) -> anyhow::Result<Self> {
        Self::over_preset(Figment::from(Toml::string(text)))
    }

    /// Settings over those of the preset that they name.
    fn over_preset(settings: Figment) -> anyhow::Result<Self> {
        let preset = if settings.contains("preset") { settings.extract_inner("preset")? } else { Preset::Cpn };
        let config: Self = Figment::from(Serialized::defaults(Self::from(preset))).merge(settings).extract()?;
        config.validate()?;
        Ok(config)
    }

    /// Checks the settings, without access to files.
    ///
    /// # Errors
    /// The invalid field, with the expected and the given value.
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

    /// Name of the run: the stem of its checkpoint's file.
    pub fn name(&self) -> String {
        self.out.file_stem().unwrap_or_default().to_string_lossy().into_owned()
    }

    /// Folder of progress, events and curve.
    pub fn run_dir(&self) -> PathBuf {
        self.run_dir.clone().unwrap_or_else(|| Path::new("runs/training").join(self.name()))
    }

    /// Configuration of the model and its training.
    pub fn recipe(&self) -> Recipe {
        Recipe { model: self.model.clone(), training: self.training.clone() }
    }
}
