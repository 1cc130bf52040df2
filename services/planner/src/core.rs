//! Planner service without transports: validated requests in, answers out.

use crate::config::Config;
use crate::goals::Goals;
use crate::model::{Computing, Description, Model, RANDOM};
use crate::model_thread::ModelThread;
use crate::served::{check_capacity, unknown_model};
use crate::signatures::Signatures;
use crate::task::{Answer, PlanTask, approach_from_wire};
use anyhow::{Context, ensure};
use service_kit::files;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tokio::sync::Semaphore;
use tracing::{Span, info, warn};
use wire::checkpoint::CheckpointManifest;
use wire::planner::{
    CheckpointSource, Goal, ListModelsResponse, LoadModelRequest, LoadModelResponse, ModelInfo, PlanRequest,
    PlanResponse, RegisterGoalRequest, RegisterGoalResponse, UnloadModelRequest, UnloadModelResponse,
};
use wire::{Code, Error, Image, Observation};

/// Maximum number of concurrent checkpoint loads: each may take as much memory as the largest model.
const MAX_LOADS: usize = 4;
/// File name extension of checkpoints.
const EXTENSION: &str = "safetensors";

/// Handle of the planner, for its transports and for programs that embed it. Clones share the planner.
#[derive(Debug, Clone)]
pub struct PlannerCore {
    thread: ModelThread,
    goals: Arc<Goals>,
    loads: Arc<Semaphore>,
    models_dir: Arc<Path>,
    signatures: Arc<Signatures>,
    computing: Computing,
    model_capacity: usize,
}

impl PlannerCore {
    /// Loads all checkpoints of the model folder and starts serving them.
    ///
    /// # Errors
    /// If a checkpoint cannot be loaded or lacks a required signature, there are more than the model capacity, or a file of
    /// keys is invalid. The error names the file.
    pub(crate) async fn start(config: &Config) -> anyhow::Result<Self> {
        let engine = engines::build(config.engine, config.device, config.threads.get().into())?;
        let computing = Computing { engine, precision: config.precision.where_faster() };
        if computing.precision != config.precision {
            warn!(
                "precision: expected a processor with instructions for bfloat16 (AVX512-BF16), got none; embedding in float32"
            );
        }

        let signatures = Arc::new(Signatures::new(config)?);
        let (folder, checked) = (config.models_dir.clone(), Arc::clone(&signatures));
        let used = computing.clone();
        let models = tokio::task::spawn_blocking(move || load_all(&folder, &checked, &used)).await??;
        let (capacity, got) = (usize::from(config.model_capacity.get()), models.len());
        ensure!(got <= capacity, "model_capacity: expected room for the {got} models that are there, got {capacity}");
        for Model { info, .. } in &models {
            info!(model = info.name, method = info.method, digest = info.digest, "serving");
        }

        Ok(Self {
            thread: ModelThread::start(config, models).context("starting the model thread")?,
            goals: Arc::new(Goals::new(config.goal_capacity)),
            loads: Arc::new(Semaphore::new(MAX_LOADS)),
            models_dir: config.models_dir.clone().into(),
            signatures,
            computing,
            model_capacity: capacity,
        })
    }

    /// Plans actions towards the goal with the named model. A goal that is not an id is registered.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for an image that is not 84 x 84, an image for a model of positions, or the reverse, or no number of
    /// steps left for a model that takes it; `NOT_FOUND` for an unknown model or goal id; `FAILED_PRECONDITION` if
    /// the render specs of observation, goal and training data differ, or the required checkpoint is not kept;
    /// `RESOURCE_EXHAUSTED` if the queue is full, or the expected wait exceeds the deadline; `DEADLINE_EXCEEDED` once the deadline
    /// has passed; `INTERNAL` for a plan that is not finite; `UNAVAILABLE` during shutdown.
    pub async fn plan(&self, request: PlanRequest) -> Result<PlanResponse, Error> {
        self.thread.plan(self.task(request)?).await
    }

    /// Callback form of `plan`: `reply` is called once, on a thread where it may block.
    pub(crate) fn plan_then(&self, request: PlanRequest, reply: impl FnOnce(Answer) + Send + 'static) {
        match self.task(request) {
            Ok(task) => self.thread.plan_then(task, reply),
            Err(error) => self.thread.outbox().put(move || reply(Err(error))),
        }
    }

    /// Resolves the names in a request and checks its images.
    fn task(&self, request: PlanRequest) -> Result<PlanTask, Error> {
        let PlanRequest {
            model,
            goal,
            observation,
            seed,
            deadline,
            model_digest,
            search,
            warm_start,
            steps_left,
            approach,
        } = request;
        if let Observation::Image(image) = &observation {
            check_size("observation", image)?;
        }
        if !self.thread.models().contains_key(&model) {
            return Err(unknown_model(&model, self.thread.models().keys()));
        }

        let (goal_field, (goal_id, goal)) = match goal {
            Goal::Id(id) => {
                let goal = self.goals.get(&id)?;
                ("goal_id", (id, goal))
            }
            Goal::Image(image) => {
                check_size("goal_image", &image)?;
                ("goal_image", self.goals.register(image.into()))
            }
            Goal::Position(position) => ("goal_position", self.goals.register(position.into())),
        };

        Ok(PlanTask {
            model,
            model_digest,
            goal_id,
            goal,
            goal_field,
            observation,
            seed,
            deadline,
            search,
            warm_start,
            steps_left,
            approach: approach.map(approach_from_wire),
            span: Span::current(),
        })
    }

    /// Registers a goal image; the same image gets the same id.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for an image that is not 84 x 84.
    pub fn register_goal(&self, request: RegisterGoalRequest) -> Result<RegisterGoalResponse, Error> {
        check_size("image", &request.image)?;
        let (goal_id, _) = self.goals.register(request.image.into());
        Ok(RegisterGoalResponse { goal_id })
    }

    /// Loads a checkpoint, warms it up, and swaps it in between two plans. Until then, and after any error, the previous model
    /// of that name is served.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for a faulty checkpoint, with the reason; `NOT_FOUND` for a file that is not in the model folder;
    /// `FAILED_PRECONDITION` for the name `random`, or for a missing signature where one is enforced; `RESOURCE_EXHAUSTED` for
    /// too many concurrent loads, or a new name beyond the model capacity.
    pub async fn load_model(&self, request: LoadModelRequest) -> Result<LoadModelResponse, Error> {
        check_replaceable(&request.model)?;
        self.check_capacity(&request.model)?;
        let _load = self.loads.try_acquire().map_err(|_| {
            Error::new(Code::ResourceExhausted, "queue", "a free place", format!("{MAX_LOADS} checkpoints loading"))
        })?;
        let (folder, signatures) = (Arc::clone(&self.models_dir), Arc::clone(&self.signatures));
        let computing = self.computing.clone();
        let load = move || Model::load(&folder, request, &signatures, &computing);
        Ok(LoadModelResponse { model: self.swap_in(load).await? })
    }

    /// Loads a published checkpoint as `load_model` does; the bytes must match the manifest, and are fetched only after its
    /// signature has been verified.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for a faulty checkpoint, or one that does not match the manifest; `FAILED_PRECONDITION` for the name
    /// `random`, or for a missing signature where one is enforced; `RESOURCE_EXHAUSTED` for a new name beyond the model
    /// capacity; the errors of `fetch`.
    pub(crate) async fn load_published(
        &self,
        manifest: CheckpointManifest,
        fetch: impl Future<Output = Result<Vec<u8>, Error>>,
    ) -> Result<(), Error> {
        check_replaceable(&manifest.model)?;
        self.check_capacity(&manifest.model)?;
        self.signatures.check_published(&manifest)?;
        let bytes = fetch.await?;
        // Waits for a place, where a client's request would be refused: an announcement has no client to retry it.
        let _load = self.loads.acquire().await;
        let computing = self.computing.clone();
        self.swap_in(move || Model::published(manifest, &bytes, &computing)).await.map(drop)
    }

    /// Stops serving a model and all its checkpoints. Searches in progress with it are finished.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown name; `FAILED_PRECONDITION` for `random`; `UNAVAILABLE` during shutdown.
    pub async fn unload_model(
        &self,
        UnloadModelRequest { model }: UnloadModelRequest,
    ) -> Result<UnloadModelResponse, Error> {
        check_replaceable(&model)?;
        self.thread.unload(model.clone()).await?;
        info!(model, "no longer serving");
        Ok(UnloadModelResponse)
    }

    /// Checks the model capacity for a name, before the checkpoint is read.
    fn check_capacity(&self, model: &str) -> Result<(), Error> {
        check_capacity(model, self.thread.models().keys(), self.model_capacity)
    }

    async fn swap_in(&self, load: impl FnOnce() -> Result<Model, Error> + Send + 'static) -> Result<ModelInfo, Error> {
        let loading = tokio::task::spawn_blocking(load);
        let model = loading.await.map_err(|e| Error::invalid("checkpoint", "one that can be loaded", e))??;
        self.serve(model).await
    }

    /// Serves a method built in process, in place of the model of its name, from the next plan on. Signatures are not checked.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` for the name `random`; `UNAVAILABLE` during shutdown.
    pub async fn serve(&self, model: Model) -> Result<ModelInfo, Error> {
        check_replaceable(&model.info.name)?;
        let info = model.info.clone();
        self.thread.serve(model).await?;
        info!(model = info.name, method = info.method, version = info.version, digest = info.digest, "serving");
        Ok(info)
    }

    /// Served models, ordered by name.
    pub fn list_models(&self) -> ListModelsResponse {
        ListModelsResponse { models: self.thread.models().values().map(|model| model.info.clone()).collect() }
    }

    /// Description of a served model.
    ///
    /// # Errors
    /// `NOT_FOUND` for an unknown name.
    pub(crate) fn describe(&self, model: &str) -> Result<Description, Error> {
        let models = self.thread.models();
        models.get(model).cloned().ok_or_else(|| unknown_model(model, models.keys()))
    }

    /// Ends searches in progress, with an error.
    pub(crate) fn abort_searches(&self) {
        self.thread.abort_searches();
    }

    /// Finishes the queued plans, and refuses later requests.
    pub(crate) async fn stop(&self) {
        self.thread.stop().await;
    }
}

/// Loads all checkpoints in `folder`, and the model `random`.
fn load_all(folder: &Path, signatures: &Signatures, computing: &Computing) -> anyhow::Result<Vec<Model>> {
    let mut models = vec![Model::random()];
    for path in checkpoints(folder)? {
        let loaded = load_file(folder, &path, signatures, computing);
        models.push(loaded.with_context(|| format!("checkpoint {}", path.display()))?);
    }
    if models.len() == 1 {
        warn!(folder = %folder.display(), "no checkpoints: only the random model is served");
    }
    Ok(models)
}

/// Checkpoint files of a folder, ordered by name. Only the default folder may be missing.
fn checkpoints(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    if folder == Config::default().models_dir && !folder.try_exists().context("models_dir")? {
        return Ok(Vec::new());
    }
    let mut paths = files::list(folder).context("models_dir")?;
    paths.retain(|path| path.extension().is_some_and(|e| e == EXTENSION));
    Ok(paths)
}

fn load_file(folder: &Path, path: &Path, signatures: &Signatures, computing: &Computing) -> Result<Model, Error> {
    let text = |part: Option<&std::ffi::OsStr>| part.unwrap_or_default().to_string_lossy().into_owned();
    let source = CheckpointSource::File(text(path.file_name()));
    let request = LoadModelRequest { model: text(path.file_stem()), source };
    // File names are untrusted; encoding and decoding applies the validation of messages to them.
    let request: LoadModelRequest = wire::decode(&wire::encode(request))?;
    check_replaceable(&request.model)?;
    Model::load(folder, request, signatures, computing)
}

fn check_replaceable(name: &str) -> Result<(), Error> {
    if name == RANDOM {
        return Err(Error::new(Code::FailedPrecondition, "model", format!("a name other than {RANDOM}"), name));
    }
    Ok(())
}

fn check_size(field: &str, image: &Image) -> Result<(), Error> {
    for (side, got) in [("height", image.height()), ("width", image.width())] {
        if i64::from(got) != cpn::images::SIZE {
            return Err(Error::invalid(side, cpn::images::SIZE, got).within(field));
        }
    }
    Ok(())
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "tests")]
mod tests {
    use super::*;
    use std::sync::{Mutex, mpsc};
    use std::time::Duration;
    use wire::Position;

    const PATIENCE: Duration = Duration::from_secs(60);

    fn request() -> PlanRequest {
        let position = Position::new([0.0; 3]).unwrap();
        PlanRequest::new(RANDOM, Goal::Position(position), position.into())
    }

    /// Blocking replies, however many, delay no other request.
    #[tokio::test(flavor = "multi_thread")]
    async fn blocking_replies_delay_no_other_request() {
        let models_dir = tempfile::TempDir::new().unwrap();
        let config = Config { models_dir: models_dir.path().into(), ..Config::default() };
        let core = PlannerCore::start(&config).await.unwrap();

        let (sender, entered) = mpsc::channel();
        let (release, released) = mpsc::channel::<()>();
        let released = Arc::new(Mutex::new(released));
        let unread = || {
            let (sender, released) = (sender.clone(), Arc::clone(&released));
            move |answer: Answer| {
                answer.unwrap();
                sender.send(()).unwrap();
                // Until it is released, or the test ends.
                let _ = released.lock().unwrap().recv();
            }
        };
        let entered = Arc::new(Mutex::new(entered));
        let has_entered = || {
            let entered = Arc::clone(&entered);
            tokio::task::spawn_blocking(move || entered.lock().unwrap().recv_timeout(PATIENCE).unwrap())
        };

        for round in 0..20 {
            core.plan_then(request(), unread());
            has_entered().await.unwrap();
            let planned = tokio::time::timeout(PATIENCE, core.plan(request())).await;
            planned.unwrap_or_else(|_| panic!("plan {round} waits for an answer to another client")).unwrap();
            let swapped = tokio::time::timeout(
                PATIENCE,
                core.serve(Model::new(
                    ModelInfo { name: "other".into(), ..Model::random().info },
                    String::new(),
                    Model::random().method,
                )),
            );
            swapped.await.unwrap_or_else(|_| panic!("swap {round} waits for an answer to a client")).unwrap();
        }

        // The blocked replies return one by one; plans continue as before.
        for _ in 0..20 {
            release.send(()).unwrap();
            core.plan(request()).await.unwrap();
        }
        tokio::time::timeout(PATIENCE, core.stop()).await.unwrap();
        assert_eq!(core.plan(request()).await.unwrap_err().code, Code::Unavailable);
    }

    /// Shutdown completes while a reply blocks.
    #[tokio::test(flavor = "multi_thread")]
    async fn a_blocking_reply_does_not_delay_shutdown() {
        let models_dir = tempfile::TempDir::new().unwrap();
        let config = Config { models_dir: models_dir.path().into(), ..Config::default() };
        let core = PlannerCore::start(&config).await.unwrap();
        let (sender, entered) = mpsc::channel();
        let (release, released) = mpsc::channel::<()>();
        core.plan_then(request(), move |_| {
            sender.send(()).unwrap();
            let _ = released.recv();
        });
        tokio::task::spawn_blocking(move || entered.recv_timeout(PATIENCE).unwrap()).await.unwrap();
        tokio::time::timeout(PATIENCE, core.stop()).await.unwrap();
        drop(release);
    }
}
