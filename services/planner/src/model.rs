//! A model as it is served, and what is checked before it is.

use cpn::checkpoint::{self, Checkpoint, Provenance};
use cpn::{Input, Method, Random, images, positions};
use service_kit::files;
use std::fmt;
use std::io;
use std::path::Path;
use tch::{Kind, Tensor};
use wire::checkpoint::CheckpointManifest;
use wire::planner::{CheckpointSource, LoadModelRequest, ModelInfo};
use wire::{Code, Error, Observation};

/// Name of the control of every comparison, always served.
pub const RANDOM: &str = "random";
/// A of the control: hand displacement x, y, z and gripper effort.
const RANDOM_ACTIONS: i64 = 4;

/// A method with the name and digest it is served under.
pub struct Model {
    /// What clients are told of it.
    pub info: ModelInfo,
    /// How the pictures were rendered that it was trained on; empty if their origin is unknown.
    pub render_spec: String,
    /// What plans.
    pub method: Box<dyn Method>,
}

/// The numbers of one plan, all finite.
#[derive(Debug)]
pub(crate) struct Planned {
    /// `[H][A]`, not clipped.
    pub(crate) actions: Vec<Vec<f32>>,
    /// One before each update and one after the last.
    pub(crate) inner_losses: Vec<f32>,
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
    /// If the file is not there, or for anything wrong with the checkpoint, with the reason in `got`.
    pub(crate) fn load(folder: &Path, request: LoadModelRequest) -> Result<Self, Error> {
        let bytes = match request.source {
            CheckpointSource::Bytes(bytes) => bytes,
            // One byte more than a checkpoint may have, so that it is refused as too large.
            CheckpointSource::File(name) => files::read_at_most(&folder.join(&name), checkpoint::MAX_BYTES + 1)
                .map_err(|e| match e.kind() {
                    io::ErrorKind::NotFound => Error::new(Code::NotFound, "file", "a file in the model folder", name),
                    _ => Error::invalid("file", "a readable file", format!("{name}: {e}")),
                })?,
        };
        Self::tried(request.model, 0, read(&bytes)?)
    }

    /// Reads a published checkpoint, if the bytes are what its manifest says, and tries it once. Blocks.
    ///
    /// # Errors
    /// If they are not, with the manifest's field, or for anything wrong with the checkpoint.
    pub(crate) fn published(manifest: CheckpointManifest, bytes: &[u8]) -> Result<Self, Error> {
        let CheckpointManifest { model, version, digest, config_digest, .. } = manifest;
        let got = checkpoint::digest(bytes);
        if got != digest {
            return Err(Error::invalid("digest", digest, got));
        }
        let loaded = read(bytes)?;
        if loaded.config_digest != config_digest {
            return Err(Error::invalid("config_digest", config_digest, loaded.config_digest));
        }
        Self::tried(model, version, loaded)
    }

    /// What a checkpoint holds, once it has planned.
    fn tried(name: String, version: u32, loaded: Checkpoint) -> Result<Self, Error> {
        let Provenance { training_tasks, render_spec, .. } = loaded.provenance;
        let info = info(name, version, &loaded.agent, loaded.digest, training_tasks);
        let model = Self { info, render_spec, method: Box::new(loaded.agent) };
        model.warm_up()?;
        Ok(model)
    }

    /// Plans once, from black to white or from one corner of space to another: the first request does not pay for it, and
    /// weights that are finite but lead to plans that are not are found out.
    fn warm_up(&self) -> Result<(), Error> {
        let [x, x_g] = if self.method.takes(Input::Image) {
            [0, u8::MAX].map(|level| self.encode_bytes(&vec![level; images::BYTES]))
        } else {
            [-1.0, 1.0].map(|metres| self.encode_metres([metres; 3]))
        };
        self.plan(&x, &x_g, 0).map(drop).map_err(|e| Error::invalid("checkpoint", "one whose plans are finite", e))
    }

    /// Checks that observations like this one, which came as `field`, are what the model takes.
    ///
    /// # Errors
    /// If they are not.
    pub(crate) fn check_takes(&self, field: &str, observation: &Observation) -> Result<(), Error> {
        let (input, expected, got) = match observation {
            Observation::Image(_) => (Input::Image, "a position", "an image"),
            Observation::Position(_) => (Input::Position, "an image", "a position"),
        };
        if self.method.takes(input) { Ok(()) } else { Err(Error::invalid(field, expected, got)) }
    }

    /// The embedding `[1, Z]` of an image of 84 x 84 or of a position.
    pub(crate) fn encode(&self, observation: &Observation) -> Tensor {
        match observation {
            Observation::Image(image) => self.encode_bytes(image.data()),
            Observation::Position(position) => self.encode_metres(position.metres()),
        }
    }

    fn encode_bytes(&self, image: &[u8]) -> Tensor {
        self.method.encode(&images::from_bytes(image).expect("images are checked as they arrive"))
    }

    fn encode_metres(&self, position: [f32; 3]) -> Tensor {
        self.method.encode(&positions::from_metres(&[position]))
    }

    /// Plans from x to x_g, both `[1, Z]`.
    ///
    /// # Errors
    /// If any number of the plan is not finite.
    pub(crate) fn plan(&self, x: &Tensor, x_g: &Tensor, seed: u64) -> Result<Planned, Error> {
        let plan = self.method.plan(x, x_g, seed);
        let actions = plan.actions.squeeze_dim(0).unbind(0).iter().map(floats).collect::<Vec<_>>();
        let inner_losses = plan.inner_losses.iter().flat_map(floats).collect::<Vec<_>>();
        let latent_distance = (x.size()[1] > 0).then(|| (x - x_g).norm().double_value(&[]) as f32);
        check_finite("actions", &actions.concat())?;
        check_finite("inner_losses", &inner_losses)?;
        check_finite("latent_distance", latent_distance.as_slice())?;
        Ok(Planned { actions, inner_losses, latent_distance })
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

fn check_finite(field: &str, values: &[f32]) -> Result<(), Error> {
    match values.iter().find(|value| !value.is_finite()) {
        Some(value) => Err(Error::new(Code::Internal, field, "finite numbers", value)),
        None => Ok(()),
    }
}

/// A float32 vector's values.
fn floats(vector: &Tensor) -> Vec<f32> {
    Vec::try_from(vector.to_kind(Kind::Float)).expect("a vector of float32")
}
