//! Training run: training over all epochs, with progress, interruption and resumption.

use crate::training::config::Config;
use crate::training::dataset::Dataset;
use crate::training::progress::{Meter, Observer};
use crate::training::sampler::Sampler;
use anyhow::{Context, ensure};
use cpn::archive::{self, Tensors};
use cpn::checkpoint::{self, Provenance};
use cpn::{Learner, Model, Precision, Recipe};
use serde::{Deserialize, Serialize};
use service_kit::files;
use std::f64::consts::PI;
use std::path::PathBuf;
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};
use tracing::info;

/// File name extension of a run's saved state.
pub(crate) const RESUME: &str = "resume";

/// Outcome of a run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The checkpoint is written.
    Finished {
        /// SHA-256 of the checkpoint, in hex.
        digest: String,
    },
    /// The run was interrupted, and can be resumed.
    Interrupted {
        /// Number of completed steps.
        step: u64,
    },
}

/// Identity of a saved state: it is resumed only by a run with the same recipe, seed and data.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ResumePoint {
    recipe: Recipe,
    seed: u64,
    data_digest: String,
    /// Number of completed steps.
    step: u64,
    /// Running mean of the loss, for the progress.
    loss: Option<f64>,
}

/// Trains until the checkpoint is written or `observer` interrupts the run, from a saved state if it exists.
///
/// # Errors
/// If the settings are out of range or do not fit the demonstrations, these cannot be read, another process writes the checkpoint,
/// the saved state belongs to another run, the loss is not finite, a file cannot be written, or the observer fails.
pub fn run(config: &Config, observer: &mut dyn Observer) -> anyhow::Result<Outcome> {
    config.validate()?;
    ensure!(!config.out.is_dir(), "out: expected the path of a file, got that of a folder, {}", config.out.display());
    let recipe = config.recipe();
    let Recipe { model, training } = &recipe;

    let engine = engines::build(config.engine, config.device, config.threads)?;
    let save_interval = Duration::try_from_secs_f64(config.save_interval_seconds).context("save_interval_seconds")?;
    let dataset = Dataset::load(&config.dataset, &config.hold_out, model.encoder.input())?;

    let (expected, got) = (model.actions, dataset.action_size());
    ensure!(expected == got as i64, "model.actions: expected {got} as the demonstrations have, got {expected}");
    ensure!(
        training.losses.position == 0.0 || !dataset.hand_positions().is_empty(),
        "training.losses.position: expected demonstrations whose states begin with the hand's position, got some without"
    );
    let _keeper = files::take_over_file(&config.out).context("out")?;

    let tasks: Vec<String> = dataset.tasks().into_iter().map(str::to_owned).collect();
    if training.precision.where_faster() != training.precision {
        info!("training.precision: the processor has no instructions for bfloat16 (AVX512-BF16); training in float32");
    }
    info!(tasks = tasks.len(), episodes = dataset.episodes().len(), samples = dataset.sample_count(), "demonstrations");

    let mut learner = engine.learner(Model::new(model.clone(), config.seed), training)?;
    let state = Saved { path: config.out.with_extension(RESUME), config, dataset: &dataset };
    let (start, loss) = state.resume(&mut *learner)?;
    observer.begin(start)?;

    let sampler = Sampler::new(&dataset, &recipe, config.seed);
    let total = sampler.steps_per_epoch() * u64::from(training.epochs);
    let mut meter = Meter::new(total, training.epochs.into(), sampler.samples_before(start), loss);
    let mut saved = Instant::now();
    let interrupted = thread::scope(|scope| {
        // The next batch is prepared during a step.
        let (sender, batches) = mpsc::sync_channel(1);
        scope.spawn(move || {
            let mut batches = sampler.batches(start).take((total - start) as usize);
            // Sending fails once the run is interrupted.
            let _ = batches.try_for_each(|batch| sender.send(batch).ok());
        });

        for (step, batch) in (start..total).zip(batches) {
            if observer.should_stop(step) {
                state.save(step, &*learner, &meter)?;
                return Ok(Some(step));
            }
            let learning_rate = one_cycle(step, total, training.peak_learning_rate);
            let result = learner.step(&batch, learning_rate).with_context(|| format!("step {step}"))?;
            let samples = batch.observations.len();
            observer.observe(&meter.step(step + 1, samples, result.loss, learning_rate, result.gradient_norm))?;
            if saved.elapsed() >= save_interval {
                state.save(step + 1, &*learner, &meter)?;
                saved = Instant::now();
            }
        }
        anyhow::Ok(None)
    })?;
    if let Some(step) = interrupted {
        return Ok(Outcome::Interrupted { step });
    }

    let provenance = Provenance {
        training_tasks: tasks,
        data_digest: dataset.digest().to_owned(),
        render_spec: dataset.render_spec().to_owned(),
        seed: config.seed,
        training: training.clone(),
    };
    let mut model = learner.model();
    model.set_position_step_size();
    if model.config.familiar_goals > 0 {
        // In the precision that planners have by default.
        let embeddings = engine.planner(&model, Precision::Float32)?.encode(&dataset.goals());
        model.set_familiar_goals(&embeddings);
    }
    let bytes = checkpoint::to_bytes(&model, &provenance)?;
    files::write_atomically(&config.out, &bytes)?;
    state.remove()?;
    Ok(Outcome::Finished { digest: checkpoint::digest(&bytes) })
}

/// The learning rate of a step by the one-cycle schedule (Smith, 2018): from peak / 25 to the peak over the first 30 % of the run,
/// then to 0, both along a cosine.
fn one_cycle(step: u64, total: u64, peak: f64) -> f64 {
    const WARM_UP: f64 = 0.3;
    let done = step as f64 / total as f64;
    let (low, progress) =
        if done < WARM_UP { (peak / 25.0, 1.0 - done / WARM_UP) } else { (0.0, (done - WARM_UP) / (1.0 - WARM_UP)) };
    low + (peak - low) * 0.5 * (1.0 + (PI * progress).cos())
}

/// Saved state of a run, beside its checkpoint.
struct Saved<'a> {
    path: PathBuf,
    config: &'a Config,
    dataset: &'a Dataset,
}

impl Saved<'_> {
    fn point(&self, step: u64, loss: Option<f64>) -> ResumePoint {
        let Config { seed, .. } = *self.config;
        ResumePoint { recipe: self.config.recipe(), seed, data_digest: self.dataset.digest().to_owned(), step, loss }
    }

    fn save(&self, step: u64, learner: &dyn Learner, meter: &Meter) -> anyhow::Result<()> {
        files::write_atomically(&self.path, &archive::to_bytes(&learner.state(), &self.point(step, meter.loss))?)
    }

    /// Restores the saved state if it exists; returns the number of completed steps and the running mean of the loss.
    fn resume(&self, learner: &mut dyn Learner) -> anyhow::Result<(u64, Option<f64>)> {
        if !self.path.exists() {
            return Ok((0, None));
        }
        let mut restore = || {
            let (state, got): (Tensors, ResumePoint) = archive::from_bytes(&std::fs::read(&self.path)?)?;
            let expected = self.point(got.step, got.loss);
            ensure!(expected == got, "expected the state of this run, {expected:?}, got that of another, {got:?}");
            learner.restore(&state, u32::try_from(got.step)?)?;
            info!(step = got.step, "resumed");
            Ok((got.step, got.loss))
        };
        restore().with_context(|| format!("resuming from {} (remove it to start anew)", self.path.display()))
    }

    fn remove(&self) -> anyhow::Result<()> {
        if self.path.exists() {
            std::fs::remove_file(&self.path).with_context(|| self.path.display().to_string())?;
        }
        Ok(())
    }
}
