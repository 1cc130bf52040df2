//! A training run: the outer loop over all demonstrations, with progress, interruption and resumption.

use crate::adam::Adam;
use crate::dataset::{Batch, Dataset};
use crate::positions::Trajectories;
use crate::progress::{Meter, Observer};
use anyhow::{Context, ensure};
use cpn::archive::{self, Tensors};
use cpn::checkpoint::{self, Provenance};
use cpn::{Agent, EncoderConfig, EncoderPreset, Input, MethodKind, ModelConfig};
use serde::{Deserialize, Serialize};
use service_kit::files;
use std::f64::consts::PI;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tracing::info;

/// How often a run saves its state.
const SAVE_INTERVAL: Duration = Duration::from_secs(60);

/// Settings of a run; the defaults are those of the shipped checkpoints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Folder of the demonstrations.
    pub dataset: PathBuf,
    /// Where the checkpoint goes.
    pub out: PathBuf,
    /// Method to train.
    pub method: MethodKind,
    /// What observations and goals are; positions are for tasks whose goal is one.
    pub input: Input,
    /// Encoder of images to train it with.
    pub encoder: EncoderPreset,
    /// H; the paper's if none is given.
    pub horizon: Option<i64>,
    /// U; the paper's if none is given.
    pub updates: Option<i64>,
    /// Share of the samples whose goal is a position that the hand reached later, instead of the one it was given.
    pub hindsight: f64,
    /// Tasks that the model must not see.
    pub hold_out: Vec<String>,
    /// Passes over every frame.
    pub epochs: u32,
    /// Samples of a step.
    pub batch_size: usize,
    /// Highest learning rate of the one-cycle schedule.
    pub peak_learning_rate: f64,
    /// Longest gradient, as a norm over all weights.
    pub max_gradient_norm: f64,
    /// Seed of initialisation and sampling.
    pub seed: u64,
    /// Threads of libtorch; 0 leaves it to libtorch.
    pub threads: i32,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            dataset: "data/demonstrations".into(),
            out: "runs/checkpoints/cpn.safetensors".into(),
            method: MethodKind::Cpn,
            input: Input::Image,
            encoder: EncoderPreset::Paper,
            horizon: None,
            updates: None,
            hindsight: 0.0,
            hold_out: Vec::new(),
            epochs: 5,
            batch_size: 128,
            peak_learning_rate: 1.5e-3,
            max_gradient_norm: 10.0,
            seed: 0,
            threads: 0,
        }
    }
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Outcome {
    /// The checkpoint of this digest is written.
    Finished {
        /// SHA-256, in hex.
        digest: String,
    },
    /// Stopped after so many steps; the same run goes on from there.
    Interrupted {
        /// Steps done.
        step: u64,
    },
}

/// What a saved state belongs to.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ResumePoint {
    config: Config,
    data_digest: String,
    step: u64,
    /// Running mean of the loss, for those who watch.
    loss: Option<f64>,
}

/// What a training run reads.
pub trait Demonstrations {
    /// A moment of an episode.
    type Sample;
    /// Names of the tasks, in order.
    fn tasks(&self) -> Vec<String>;
    /// Number of episodes.
    fn episode_count(&self) -> usize;
    /// Number of moments with an action.
    fn sample_count(&self) -> usize;
    /// A, the size of an action.
    fn action_size(&self) -> i64;
    /// What [`crate::recordings::dataset_digest`] gives for the episodes.
    fn digest(&self) -> &str;
    /// How every frame was rendered; empty for those of a real camera, and where none is looked at.
    fn render_spec(&self) -> &str;
    /// Every moment with an action once, in an order that the seed and the epoch decide.
    fn shuffled(&self, seed: u64, epoch: u64) -> Vec<Self::Sample>;
    /// The tensors of some moments, with the next H actions of each.
    fn batch(&self, samples: &[Self::Sample], horizon: i64) -> Batch;
}

/// Trains until the checkpoint is written or `observer` stops it; from a saved state if there is one.
///
/// # Errors
/// If the demonstrations cannot be read, the saved state belongs to another run, the loss is no longer finite, a file
/// cannot be written, or the observer fails.
pub fn run(config: &Config, observer: &mut dyn Observer) -> anyhow::Result<Outcome> {
    ensure!(config.batch_size > 0 && config.epochs > 0, "batch_size and epochs: expected at least 1, got 0");
    if config.threads > 0 {
        tch::set_num_threads(config.threads);
    }
    match config.input {
        Input::Image => {
            ensure!(config.hindsight == 0.0, "hindsight: expected 0 for images, got {}", config.hindsight);
            let dataset = Dataset::load(&config.dataset, &config.hold_out)?;
            run_on(config, &dataset, config.encoder.into(), observer)
        }
        Input::Position => {
            ensure!(config.hold_out.is_empty(), "hold_out: expected none for positions, got {:?}", config.hold_out);
            let trajectories = Trajectories::load(&config.dataset, config.hindsight)?;
            let encoder = trajectories.encoder();
            run_on(config, &trajectories, encoder, observer)
        }
    }
}

fn run_on(
    config: &Config,
    dataset: &impl Demonstrations,
    encoder: EncoderConfig,
    observer: &mut dyn Observer,
) -> anyhow::Result<Outcome> {
    let tasks = dataset.tasks();
    info!(tasks = tasks.len(), episodes = dataset.episode_count(), samples = dataset.sample_count(), "demonstrations");

    let paper = ModelConfig::paper(config.method);
    let model = ModelConfig {
        encoder,
        actions: dataset.action_size(),
        horizon: config.horizon.unwrap_or(paper.horizon),
        updates: config.updates.unwrap_or(paper.updates),
        ..paper
    };
    model.validate()?;
    let agent = Agent::new(model, config.seed);
    let mut adam = Adam::new(agent.variables());
    let resume_path = config.out.with_extension("resume");
    let (mut step, loss) = resume(&resume_path, config, dataset.digest(), &mut adam)?;

    let sample_count = dataset.sample_count() as u64;
    let per_epoch = sample_count.div_ceil(config.batch_size as u64);
    let total = per_epoch * u64::from(config.epochs);
    let samples_done = step / per_epoch * sample_count + step % per_epoch * config.batch_size as u64;
    let mut meter = Meter::new(total, config.epochs.into(), samples_done, loss);
    observer.begin(step)?;
    let mut saved = Instant::now();
    while step < total {
        let epoch = step / per_epoch;
        let samples = dataset.shuffled(config.seed, epoch);
        for samples in samples.chunks(config.batch_size).skip((step % per_epoch) as usize) {
            if observer.should_stop(step) {
                save(&resume_path, config, dataset.digest(), &adam, step, &meter)?;
                return Ok(Outcome::Interrupted { step });
            }
            let batch = dataset.batch(samples, agent.config().horizon);
            let loss = agent.outer_loss(&batch.observations, &batch.goals, &batch.actions, &batch.mask);
            let value = loss.double_value(&[]);
            ensure!(value.is_finite(), "loss: expected a finite number, got {value} at step {step}");
            loss.backward();
            let learning_rate = one_cycle(step, total, config.peak_learning_rate);
            let norm = adam.step(learning_rate, config.max_gradient_norm);
            step += 1;
            observer.observe(&meter.step(step, samples.len(), value, learning_rate, norm))?;
            if saved.elapsed() > SAVE_INTERVAL {
                save(&resume_path, config, dataset.digest(), &adam, step, &meter)?;
                saved = Instant::now();
            }
        }
    }

    let provenance = Provenance {
        training_tasks: tasks,
        data_digest: dataset.digest().to_owned(),
        render_spec: dataset.render_spec().to_owned(),
        seed: config.seed,
        epochs: config.epochs,
    };
    let bytes = checkpoint::to_bytes(&agent, &provenance)?;
    files::write_atomically(&config.out, &bytes)?;
    if resume_path.exists() {
        std::fs::remove_file(&resume_path)?;
    }
    Ok(Outcome::Finished { digest: checkpoint::digest(&bytes) })
}

/// The learning rate of a step: up over the first 30 % of the run, then down, both along a cosine (Smith, 2018).
fn one_cycle(step: u64, total: u64, peak: f64) -> f64 {
    const WARM_UP: f64 = 0.3;
    let done = step as f64 / total as f64;
    let (low, progress) =
        if done < WARM_UP { (peak / 25.0, 1.0 - done / WARM_UP) } else { (0.0, (done - WARM_UP) / (1.0 - WARM_UP)) };
    low + (peak - low) * 0.5 * (1.0 + (PI * progress).cos())
}

fn save(path: &Path, config: &Config, digest: &str, adam: &Adam, step: u64, meter: &Meter) -> anyhow::Result<()> {
    let point = ResumePoint { config: config.clone(), data_digest: digest.to_owned(), step, loss: meter.loss };
    files::write_atomically(path, &archive::to_bytes(&adam.state(), &point)?)
}

/// Takes up a saved state; answers the number of steps done and the mean loss.
fn resume(path: &Path, config: &Config, digest: &str, adam: &mut Adam) -> anyhow::Result<(u64, Option<f64>)> {
    if !path.exists() {
        return Ok((0, None));
    }
    let mut take_up = || {
        let (state, point): (Tensors, ResumePoint) = archive::from_bytes(&std::fs::read(path)?)?;
        let expected = ResumePoint { config: config.clone(), data_digest: digest.to_owned(), ..point };
        let same_run = expected.config == point.config && expected.data_digest == point.data_digest;
        ensure!(same_run, "expected the state of this run, {expected:?}, got that of another, {point:?}");
        adam.restore(&state, i32::try_from(point.step)?)?;
        info!(step = point.step, "resumed");
        Ok((point.step, point.loss))
    };
    take_up().with_context(|| format!("resuming from {} (remove it to start anew)", path.display()))
}
