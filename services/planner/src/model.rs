//! Served models: loading, warm-up, checks of requests, and plans.

use crate::load::{Costs, resolve};
use crate::signatures::Signatures;
use crate::task::{Answer, Latents, PlanTask, approach_to_wire};
use cpn::checkpoint::{self, Checkpoint, Provenance};
use cpn::method::{self, Iterations, Observed, Ongoing, Query, Solver};
use cpn::{Engine, Input, Method, Plan, Precision, Random, images};
use service_kit::files;
use std::fmt;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;
use wire::checkpoint::CheckpointManifest;
use wire::planner::{CheckpointSource, LoadModelRequest, ModelInfo, PlanResponse, Search, StageTimes};
use wire::{Code, Error, Observation};

/// Name of the random baseline, which is always served.
pub const RANDOM: &str = "random";
/// Action width A of the random baseline: hand displacement x, y, z and gripper effort.
const RANDOM_ACTIONS: usize = 4;
/// Number of samples in the warm-up's sampling search, which measures the time of a rollout.
const WARM_UP_SAMPLES: usize = 32;

/// Engine of all models, with the precision of their image encoders.
#[derive(Debug, Clone)]
pub(crate) struct Computing {
    pub(crate) engine: Arc<dyn Engine>,
    pub(crate) precision: Precision,
}

/// Method with the name and digest it is served under.
pub struct Model {
    /// Description for clients.
    pub info: ModelInfo,
    /// Render spec of the training images; empty if unknown.
    pub render_spec: String,
    /// Planning method.
    pub method: Box<dyn Method>,
    /// Measured compute times of its plans.
    pub(crate) costs: Costs,
}

/// Description of a served model, for transports that tell its inputs and outputs.
#[derive(Debug, Clone)]
pub(crate) struct Description {
    /// Description for clients.
    pub(crate) info: ModelInfo,
    /// Kind of observations and goals; images for a method that takes both.
    pub(crate) input: Input,
    /// A, the number of continuous actions.
    pub(crate) actions: usize,
    /// Whether plans depend on the number of steps left.
    pub(crate) takes_steps_left: bool,
}

impl Model {
    /// Model of a method, served as `info` describes.
    pub fn new(info: ModelInfo, render_spec: String, method: Box<dyn Method>) -> Self {
        let costs = Costs::new(&info.digest, method.updates().unwrap_or_default());
        Self { info, render_spec, method, costs }
    }

    /// Description of the model.
    pub(crate) fn describe(&self) -> Description {
        Description {
            info: self.info.clone(),
            input: if self.method.takes(Input::Image) { Input::Image } else { Input::Position },
            actions: self.method.actions(),
            takes_steps_left: self.method.takes_steps_left(),
        }
    }

    /// Random baseline: uniform actions, independent of the observation.
    pub(crate) fn random() -> Self {
        let method = Random { actions: RANDOM_ACTIONS };
        let digest = checkpoint::digest(RANDOM.as_bytes());
        let info = info(RANDOM.to_owned(), 0, &method, digest, Vec::new());
        Self::new(info, String::new(), Box::new(method))
    }

    /// Loads a checkpoint, from bytes or from a file in `folder`, and warms it up. Blocks.
    ///
    /// # Errors
    /// If the file does not exist, its signature is refused, or the checkpoint is faulty, with the reason in `got`.
    pub(crate) fn load(
        folder: &Path,
        request: LoadModelRequest,
        signatures: &Signatures,
        computing: &Computing,
    ) -> Result<Self, Error> {
        let bytes = match request.source {
            CheckpointSource::Bytes(bytes) => {
                signatures.check_unsigned(&request.model)?;
                bytes
            }
            CheckpointSource::File(name) => {
                // One byte beyond the limit, so that a larger file is refused as too large.
                let read = files::read_inside(folder, &name, checkpoint::MAX_BYTES + 1);
                let bytes = read.map_err(|e| match e.kind() {
                    io::ErrorKind::NotFound => Error::new(Code::NotFound, "file", "a file in the model folder", &name),
                    _ => Error::invalid("file", "a readable file", format!("{name}: {e}")),
                })?;
                signatures.check_file(folder, &name, &bytes)?;
                bytes
            }
        };
        Self::build(request.model, 0, read(&bytes)?, computing)
    }

    /// Loads a published checkpoint, whose bytes must match the manifest, and warms it up. Blocks.
    ///
    /// # Errors
    /// If the bytes do not match the manifest, with the manifest's field, or the checkpoint is faulty.
    pub(crate) fn published(manifest: CheckpointManifest, bytes: &[u8], computing: &Computing) -> Result<Self, Error> {
        let CheckpointManifest { model, version, digest, config_digest, .. } = manifest;
        let got = checkpoint::digest(bytes);
        if got != digest {
            return Err(Error::invalid("digest", digest, got));
        }
        let loaded = read(bytes)?;
        if loaded.config_digest != config_digest {
            return Err(Error::invalid("config_digest", config_digest, loaded.config_digest));
        }
        Self::build(model, version, loaded, computing)
    }

    /// Builds the model of a checkpoint and warms it up.
    fn build(name: String, version: u32, loaded: Checkpoint, computing: &Computing) -> Result<Self, Error> {
        let Provenance { training_tasks, render_spec, .. } = loaded.provenance;
        let method = computing.engine.planner(&loaded.model, computing.precision);
        let method =
            method.map_err(|e| Error::new(Code::Internal, "checkpoint", "a model that the device holds", e))?;
        let info = info(name, version, &*method, loaded.digest, training_tasks);
        let mut model = Self::new(info, render_spec, method);
        model.warm_up()?;
        Ok(model)
    }

    /// Warm-up: plans from a black to a white image, or from one corner of space to another. It initialises everything lazy
    /// before the first request, detects finite weights that give non-finite plans, and measures compute times.
    fn warm_up(&mut self) -> Result<(), Error> {
        let (black, white) = (vec![0; images::BYTES], vec![u8::MAX; images::BYTES]);
        let ends = if self.method.takes(Input::Image) {
            [&black, &white].map(|image| Observed::Image(image))
        } else {
            [-1.0, 1.0].map(|metres| Observed::Position([metres; 3]))
        };
        let started = Instant::now();
        let ends = self.method.encode(&ends);
        self.costs.record_embedding(2, started.elapsed());

        let query = Query { x: &ends[0], x_g: &ends[1], steps_left: 1, seed: 0, start: &[], keep_initial: false };
        let updates = self.method.updates();
        let trials = updates.map(|_| (Solver::Cem(WARM_UP_SAMPLES), 1));
        let plans = [Some((Solver::Gradient, updates.unwrap_or_default())), trials];
        // Twice, since the first run is slower than later ones.
        for (solver, iterations) in plans.into_iter().flatten().flat_map(|plan| [plan, plan]) {
            let (started, iterations_left) = (Instant::now(), Iterations::Fixed(iterations));
            let plan =
                self.method.plan(&[query], &mut method::Search { solver, iterations: iterations_left }).remove(0);
            self.costs.record_rollouts(solver, method::rollouts(solver, iterations), started.elapsed());
            check_plan(&plan, query.x, query.x_g)
                .map_err(|e| Error::invalid("checkpoint", "one whose plans are finite", e))?;
        }
        Ok(())
    }

    /// Checks that a task fits the model.
    ///
    /// # Errors
    /// If the goal or observation is of the wrong kind or has another render spec, the task has no number of steps left but the
    /// method takes it, or a search or warm start but the method does not plan, or an approach but
    /// the model has no position dynamics, or the warm start is not `[horizon, actions]`.
    pub(crate) fn check(&self, task: &PlanTask) -> Result<(), Error> {
        self.check_takes(task.goal_field, &task.goal)?;
        self.check_takes(task.observation_field(), &task.observation)?;
        task.check_render_specs(&self.render_spec)?;
        if self.method.takes_steps_left() && task.steps_left.is_none() {
            return Err(Error::invalid("steps_left", "the number of steps that remain for the task", "none"));
        }
        if self.method.updates().is_none() {
            let asked = [("search", task.search.is_some()), ("warm_start", !task.warm_start.is_empty())];
            if let Some((field, _)) = asked.into_iter().find(|(_, asked)| *asked) {
                return Err(Error::invalid(field, "none for a method that does not plan", self.method.name()));
            }
        }

        if task.approach.is_some() && !self.method.moves_positions() {
            return Err(Error::invalid("approach", "none for a model without position dynamics", &self.info.name));
        }

        let (horizon, size) = (self.method.horizon(), self.method.actions());
        let start = &task.warm_start;
        if !start.is_empty() && (start.len() != horizon || start.iter().any(|action| action.len() != size)) {
            let sizes: Vec<_> = start.iter().map(Vec::len).collect();
            return Err(Error::invalid(
                "warm_start",
                format!("{horizon} actions of {size} numbers"),
                format!("{sizes:?}"),
            ));
        }
        Ok(())
    }

    fn check_takes(&self, field: &str, observation: &Observation) -> Result<(), Error> {
        let (input, expected, got) = match observation {
            Observation::Image(_) => (Input::Image, "a position", "an image"),
            Observation::Position(_) => (Input::Position, "an image", "a position"),
        };
        if self.method.takes(input) { Ok(()) } else { Err(Error::invalid(field, expected, got)) }
    }

    /// Embeddings, `[Z]` each, of 84 x 84 images or of positions.
    pub(crate) fn encode(&mut self, observations: &[&Observation]) -> Vec<Vec<f32>> {
        let observed = observations.iter().map(|observation| match observation {
            Observation::Image(image) => Observed::Image(image.data()),
            Observation::Position(position) => Observed::Position(position.metres()),
        });
        self.method.encode(&observed.collect::<Vec<_>>())
    }

    /// Plans for a batch of queries, each with the same search.
    pub(crate) fn plan(&mut self, queries: &[Query<'_>], search: Option<Search>) -> Vec<Plan> {
        let (solver, iterations) = resolve(search, self.method.updates().unwrap_or_default());
        self.method.plan(queries, &mut method::Search { solver, iterations: Iterations::Fixed(iterations) })
    }

    /// Initial state of a sliced search, which [`Method::resume`] advances.
    pub(crate) fn begin(&self, search: Option<Search>) -> Ongoing {
        let (solver, iterations) = resolve(search, self.method.updates().unwrap_or_default());
        Ongoing::new(solver, iterations, search.is_some_and(|search| search.anytime))
    }

    /// Response to a task, from its plan.
    ///
    /// # Errors
    /// If a number of the plan is not finite.
    pub(crate) fn response(&self, task: &PlanTask, plan: Plan, latents: &Latents, times: StageTimes) -> Answer {
        let latent_distance = check_plan(&plan, &latents.x, &latents.goal.x_g)?;
        let first_action = plan.actions.first().into_iter().flatten().map(|v| v.clamp(-1.0, 1.0)).collect();
        let next = plan.actions.iter().skip(1).chain(plan.actions.last()).cloned();
        Ok(PlanResponse {
            first_action,
            warm_start: if plan.inner_losses.is_empty() { Vec::new() } else { next.collect() },
            iterations: plan.iterations as u32,
            iterations_run: plan.inner_losses.len().saturating_sub(1) as u32,
            actions: plan.actions,
            inner_losses: plan.inner_losses,
            latent_distance,
            times,
            model_digest: self.info.digest.clone(),
            goal_id: task.goal_id.clone(),
            approach: latents.approach.map(approach_to_wire),
        })
    }
}

/// Checks that a plan is finite; returns the Euclidean distance between the embeddings of observation and goal, none if Z is 0.
fn check_plan(plan: &Plan, x: &[f32], x_g: &[f32]) -> Result<Option<f32>, Error> {
    let squares = x.iter().zip(x_g).map(|(x, x_g)| f64::from(x - x_g).powi(2));
    let latent_distance = (!x.is_empty()).then(|| squares.sum::<f64>().sqrt() as f32);
    check_finite("actions", plan.actions.iter().flatten())?;
    check_finite("inner_losses", plan.inner_losses.iter())?;
    check_finite("latent_distance", latent_distance.iter())?;
    Ok(latent_distance)
}

impl fmt::Debug for Model {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Model").field("info", &self.info).finish_non_exhaustive()
    }
}

fn info(name: String, version: u32, method: &dyn Method, digest: String, training_tasks: Vec<String>) -> ModelInfo {
    let horizon = u32::try_from(method.horizon()).expect("a horizon is between 1 and 64");
    ModelInfo { name, method: method.name().to_owned(), digest, training_tasks, horizon, version }
}

fn read(bytes: &[u8]) -> Result<Checkpoint, Error> {
    checkpoint::from_bytes(bytes).map_err(|e| Error::invalid("checkpoint", "one that can be loaded", e))
}

fn check_finite<'a>(field: &str, mut values: impl Iterator<Item = &'a f32>) -> Result<(), Error> {
    match values.find(|value| !value.is_finite()) {
        Some(value) => Err(Error::new(Code::Internal, field, "finite numbers", value)),
        None => Ok(()),
    }
}
