//! A model as it is served, and what is checked before it is.

use crate::signatures::Signatures;
use crate::task::PlanTask;
use cpn::checkpoint::{self, Checkpoint, Provenance};
use cpn::encoder::Precision;
use cpn::method::{self, Iterations, Observed, Query};
use cpn::{Input, Method, Plan, Planner, Random, images};
use service_kit::files;
use std::fmt;
use std::io;
use std::num::NonZeroU16;
use std::path::Path;
use wire::checkpoint::CheckpointManifest;
use wire::planner::{CheckpointSource, LoadModelRequest, ModelInfo, Search, Solver};
use wire::{Code, Error, Observation};

/// Name of the control of every comparison, always served.
pub const RANDOM: &str = "random";
/// A of the control: hand displacement x, y, z and gripper effort.
const RANDOM_ACTIONS: usize = 4;
/// Plans in a generation, if a request does not say.
const SAMPLES: u32 = 64;
/// Generations, likewise.
const GENERATIONS: u32 = 4;

/// What models compute with.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Computing {
    pub(crate) precision: Precision,
    pub(crate) threads: NonZeroU16,
}

/// A method with the name and digest it is served under.
pub struct Model {
    /// What clients are told of it.
    pub info: ModelInfo,
    /// How the pictures were rendered that it was trained on; empty if their origin is unknown.
    pub render_spec: String,
    /// What plans.
    pub method: Box<dyn Method>,
}

/// A plan, whose numbers are all finite.
#[derive(Debug)]
pub(crate) struct Planned {
    pub(crate) plan: Plan,
    /// Euclidean; none if Z is 0.
    pub(crate) latent_distance: Option<f32>,
}

impl Model {
    /// Uniform actions, whatever the images show.
    pub(crate) fn random() -> Self {
        let method = Random { actions: RANDOM_ACTIONS };
        let digest = checkpoint::digest(RANDOM.as_bytes());
        Self {
            info: info(RANDOM.to_owned(), 0, &method, digest, Vec::new()),
            render_spec: String::new(),
            method: Box::new(method),
        }
    }

    /// Reads a checkpoint, from the bytes or from a file in `folder`, and tries it once. Blocks.
    ///
    /// # Errors
    /// If the file is not there or its signature is refused, or for anything wrong with the checkpoint, with the reason in `got`.
    pub(crate) fn load(
        folder: &Path,
        request: LoadModelRequest,
        signatures: &Signatures,
        computing: Computing,
    ) -> Result<Self, Error> {
        let bytes = match request.source {
            CheckpointSource::Bytes(bytes) => {
                signatures.check_unsigned(&request.model)?;
                bytes
            }
            CheckpointSource::File(name) => {
                // One byte more than a checkpoint may have, so that it is refused as too large.
                let read = files::read_at_most(&folder.join(&name), checkpoint::MAX_BYTES + 1);
                let bytes = read.map_err(|e| match e.kind() {
                    io::ErrorKind::NotFound => Error::new(Code::NotFound, "file", "a file in the model folder", &name),
                    _ => Error::invalid("file", "a readable file", format!("{name}: {e}")),
                })?;
                signatures.check_file(folder, &name, &bytes)?;
                bytes
            }
        };
        Self::tried(request.model, 0, read(&bytes)?, computing)
    }

    /// Reads a published checkpoint, if the bytes are what its manifest says, and tries it once. Blocks.
    ///
    /// # Errors
    /// If they are not, with the manifest's field, or for anything wrong with the checkpoint.
    pub(crate) fn published(manifest: CheckpointManifest, bytes: &[u8], computing: Computing) -> Result<Self, Error> {
        let CheckpointManifest { model, version, digest, config_digest, .. } = manifest;
        let got = checkpoint::digest(bytes);
        if got != digest {
            return Err(Error::invalid("digest", digest, got));
        }
        let loaded = read(bytes)?;
        if loaded.config_digest != config_digest {
            return Err(Error::invalid("config_digest", config_digest, loaded.config_digest));
        }
        Self::tried(model, version, loaded, computing)
    }

    /// What a checkpoint holds, once it has planned.
    fn tried(name: String, version: u32, loaded: Checkpoint, computing: Computing) -> Result<Self, Error> {
        let Provenance { training_tasks, render_spec, .. } = loaded.provenance;
        let threads = usize::from(computing.threads.get());
        let method: Box<dyn Method> = Box::new(Planner::new(loaded.agent, computing.precision, threads));
        let info = info(name, version, &*method, loaded.digest, training_tasks);
        let mut model = Self { info, render_spec, method };
        model.warm_up()?;
        Ok(model)
    }

    /// Plans once, from black to white or from one corner of space to another: the first request does not pay for it, and
    /// weights that are finite but lead to plans that are not are found out.
    fn warm_up(&mut self) -> Result<(), Error> {
        let (black, white) = (vec![0; images::BYTES], vec![u8::MAX; images::BYTES]);
        let ends = if self.method.takes(Input::Image) {
            [&black, &white].map(|image| Observed::Image(image))
        } else {
            [-1.0, 1.0].map(|metres| Observed::Position([metres; 3]))
        };
        let ends = self.method.encode(&ends);
        let queries = [Query { x: &ends[0], x_g: &ends[1], seed: 0, start: &[] }];
        let planned = self.plan(&queries, None, || false).remove(0);
        planned.map(drop).map_err(|e| Error::invalid("checkpoint", "one whose plans are finite", e))
    }

    /// Checks that the model can do what is asked of it.
    ///
    /// # Errors
    /// If the goal or the observation is not what it takes, or was rendered differently; if it is to search and cannot, or to
    /// start from actions that are not as many as it plans.
    pub(crate) fn check(&self, task: &PlanTask) -> Result<(), Error> {
        self.check_takes(task.goal_field, &task.goal)?;
        self.check_takes(task.observation_field(), &task.observation)?;
        task.check_render_specs(&self.render_spec)?;
        if self.method.updates().is_none() {
            let asked = [("search", task.search.is_some()), ("warm_start", !task.warm_start.is_empty())];
            if let Some((field, _)) = asked.into_iter().find(|(_, asked)| *asked) {
                return Err(Error::invalid(field, "none for a method that does not plan", self.method.name()));
            }
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

    /// The embeddings `[Z]` of images of 84 x 84 or of positions.
    pub(crate) fn encode(&mut self, observations: &[&Observation]) -> Vec<Vec<f32>> {
        let observed = observations.iter().map(|observation| match observation {
            Observation::Image(image) => Observed::Image(image.data()),
            Observation::Position(position) => Observed::Position(position.metres()),
        });
        self.method.encode(&observed.collect::<Vec<_>>())
    }

    /// Plans for each query. A search that goes on until the deadline asks `more` before each iteration.
    ///
    /// # Errors
    /// If any number of a plan is not finite.
    pub(crate) fn plan(
        &mut self,
        queries: &[Query<'_>],
        search: Option<Search>,
        mut more: impl FnMut() -> bool,
    ) -> Vec<Result<Planned, Error>> {
        let solver = search.map_or(Solver::Gradient, |search| search.solver);
        let samples = search.and_then(|search| search.samples).unwrap_or(SAMPLES) as usize;
        let (solver, default) = match solver {
            Solver::Gradient => (method::Solver::Gradient, self.method.updates().unwrap_or_default()),
            Solver::Cem => (method::Solver::Cem(samples), GENERATIONS as usize),
            Solver::Mppi => (method::Solver::Mppi(samples), GENERATIONS as usize),
            Solver::Hybrid => (method::Solver::Hybrid(samples), GENERATIONS as usize),
        };
        let iterations = match search {
            Some(search) if search.anytime => Iterations::While(&mut more),
            _ => Iterations::Fixed(search.and_then(|search| search.iterations).map_or(default, |count| count as usize)),
        };
        let plans = self.method.plan(queries, &mut method::Search { solver, iterations });
        plans.into_iter().zip(queries).map(|(plan, query)| Planned::new(plan, query)).collect()
    }
}

impl Planned {
    fn new(plan: Plan, query: &Query<'_>) -> Result<Self, Error> {
        let squares = query.x.iter().zip(query.x_g).map(|(x, x_g)| f64::from(x - x_g).powi(2));
        let latent_distance = (!query.x.is_empty()).then(|| squares.sum::<f64>().sqrt() as f32);
        check_finite("actions", plan.actions.iter().flatten())?;
        check_finite("inner_losses", plan.inner_losses.iter())?;
        check_finite("latent_distance", latent_distance.iter())?;
        Ok(Self { plan, latent_distance })
    }
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
