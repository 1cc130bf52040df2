//! Requests and responses of the planner service.

pub use crate::approach::Approach;
use crate::message::{action, digest, name, required};
pub use crate::search::{MAX_ITERATIONS, Search, Solver};
use crate::{Error, Image, Message, Observation, Position, proto};
use std::time::Duration;

/// Longest plan, in actions.
const MAX_HORIZON: usize = 64;
/// Largest absolute value in a warm start; executed actions are clipped to [-1, 1].
const MAX_WARM_START: f32 = 1000.0;
/// Largest number of steps left.
pub const MAX_STEPS_LEFT: u32 = 10_000;

/// Goal of a plan.
#[derive(Debug, Clone, PartialEq)]
pub enum Goal {
    /// Id of a registered goal.
    Id(String),
    /// Camera image of the finished task.
    Image(Image),
    /// Target position of the hand.
    Position(Position),
}

/// Request for a plan.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanRequest {
    /// Name of the model.
    pub model: String,
    /// Goal of the plan.
    pub goal: Goal,
    /// Current observation.
    pub observation: Observation,
    /// Seed of all randomness: the same request and seed get the same answer.
    pub seed: u64,
    /// Time limit, counted from the request's arrival, in whole milliseconds.
    pub deadline: Option<Duration>,
    /// SHA-256 of the required checkpoint, in hex; any checkpoint if none.
    pub model_digest: Option<String>,
    /// Search for the actions; the model's default if none: its updates, or the policy's plan for a familiar goal.
    pub search: Option<Search>,
    /// Initial plan of the search, `[horizon, actions]`; the policy's plan if empty.
    pub warm_start: Vec<Vec<f32>>,
    /// Number of steps that remain for the task, 1 to [`MAX_STEPS_LEFT`]; required by models that take it, ignored by others.
    pub steps_left: Option<u32>,
    /// Approach of the episode, from the response before; not together with a search or a warm start.
    pub approach: Option<Approach>,
}

/// Plan.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanResponse {
    /// Planned actions, `[horizon, actions]`, not clipped.
    pub actions: Vec<Vec<f32>>,
    /// Action to apply now: the first of the plan, clipped to [-1, 1].
    pub first_action: Vec<f32>,
    /// Inner loss before each update and after the last; empty for methods that do not plan.
    pub inner_losses: Vec<f32>,
    /// Euclidean distance between the embeddings of observation and goal; none for the random method.
    pub latent_distance: Option<f32>,
    /// Time spent in each stage.
    pub times: StageTimes,
    /// SHA-256 of the checkpoint that answered, in hex.
    pub model_digest: String,
    /// Id under which the goal is now registered.
    pub goal_id: String,
    /// Iteration at which this plan was found.
    pub iterations: u32,
    /// Iterations run in total.
    pub iterations_run: u32,
    /// Warm start of the next request: the plan shifted by one step; empty for methods that do not plan.
    pub warm_start: Vec<Vec<f32>>,
    /// Approach for the next request; none for a model without position dynamics, or a request with a search or a warm start.
    pub approach: Option<Approach>,
}

/// Time spent in each stage of a request, in seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StageTimes {
    /// Waiting in the queue.
    pub queue_seconds: f64,
    /// Embedding of the observation and, if it was not cached, of the goal.
    pub encode_seconds: f64,
    /// Search for the plan.
    pub plan_seconds: f64,
}

/// Request to register a goal image.
#[derive(Debug, Clone, PartialEq)]
pub struct RegisterGoalRequest {
    /// Camera image of the finished task.
    pub image: Image,
}

/// Id of a registered goal.
#[derive(Debug, Clone, PartialEq)]
pub struct RegisterGoalResponse {
    /// [`Image::digest`] of the goal.
    pub goal_id: String,
}

/// Source of a checkpoint.
#[derive(Debug, Clone, PartialEq)]
pub enum CheckpointSource {
    /// File name in the planner's model folder.
    File(String),
    /// Bytes of the whole checkpoint.
    Bytes(Vec<u8>),
}

/// Request to serve a checkpoint, in place of the one under its name if there is one.
#[derive(Debug, Clone, PartialEq)]
pub struct LoadModelRequest {
    /// Name to serve the model under.
    pub model: String,
    /// Source of the checkpoint.
    pub source: CheckpointSource,
}

/// Model that is now served.
#[derive(Debug, Clone, PartialEq)]
pub struct LoadModelResponse {
    /// Description of the model.
    pub model: ModelInfo,
}

/// Request to serve a model no longer.
#[derive(Debug, Clone, PartialEq)]
pub struct UnloadModelRequest {
    /// Name the model is served under.
    pub model: String,
}

/// Confirmation that the model is no longer served.
#[derive(Debug, Clone, PartialEq)]
pub struct UnloadModelResponse;

/// Request for the served models.
#[derive(Debug, Clone, PartialEq)]
pub struct ListModelsRequest;

/// Served models.
#[derive(Debug, Clone, PartialEq)]
pub struct ListModelsResponse {
    /// Models, ordered by name.
    pub models: Vec<ModelInfo>,
}

/// Description of a served model.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelInfo {
    /// Name it is served under.
    pub name: String,
    /// Method: `random`, `bc`, `te-bc`, `te-bc-horizon`, `upn` or `cpn`.
    pub method: String,
    /// SHA-256 of its checkpoint, in hex.
    pub digest: String,
    /// Tasks it was trained on.
    pub training_tasks: Vec<String>,
    /// Planning horizon, in actions.
    pub horizon: u32,
    /// Version in its manifest; 0 for a checkpoint that was not published.
    pub version: u32,
}

fn actions(field: &str, actions: Vec<proto::Action>) -> Result<Vec<Vec<f32>>, Error> {
    if actions.len() > MAX_HORIZON {
        return Err(Error::invalid(field, format!("at most {MAX_HORIZON} actions"), actions.len()));
    }
    actions.into_iter().map(action).collect::<Result<_, _>>().map_err(|e| e.within(field))
}

/// Validates a warm start: values are bounded, since a search from huge ones would overflow.
fn warm_start(field: &str, plan: Vec<proto::Action>) -> Result<Vec<Vec<f32>>, Error> {
    let plan = actions(field, plan)?;
    match plan.iter().flatten().find(|value| value.abs() > MAX_WARM_START) {
        Some(value) => Err(Error::invalid(field, format!("numbers from -{MAX_WARM_START} to {MAX_WARM_START}"), value)),
        None => Ok(plan),
    }
}

/// Validates a number of steps left.
fn steps_left(field: &str, steps: u32) -> Result<u32, Error> {
    if (1..=MAX_STEPS_LEFT).contains(&steps) {
        Ok(steps)
    } else {
        Err(Error::invalid(field, format!("1 to {MAX_STEPS_LEFT}"), steps))
    }
}

impl PlanRequest {
    /// Request with the model's default search, seed 0, and no deadline.
    pub fn new(model: impl Into<String>, goal: Goal, observation: Observation) -> Self {
        Self {
            model: model.into(),
            goal,
            observation,
            seed: 0,
            deadline: None,
            model_digest: None,
            search: None,
            warm_start: Vec::new(),
            steps_left: None,
            approach: None,
        }
    }
}

impl Message for PlanRequest {
    type Proto = proto::PlanRequest;
}

impl TryFrom<proto::PlanRequest> for PlanRequest {
    type Error = Error;

    fn try_from(request: proto::PlanRequest) -> Result<Self, Error> {
        let goal = match request.goal.ok_or_else(|| Error::missing("goal"))? {
            proto::plan_request::Goal::GoalId(id) => Goal::Id(digest("goal_id", id)?),
            proto::plan_request::Goal::GoalImage(image) => {
                Goal::Image(image.try_into().map_err(|e: Error| e.within("goal_image"))?)
            }
            proto::plan_request::Goal::GoalPosition(position) => {
                Goal::Position(position.try_into().map_err(|e: Error| e.within("goal_position"))?)
            }
        };

        let observation = match request.observed.ok_or_else(|| Error::missing("observation"))? {
            proto::plan_request::Observed::Observation(image) => {
                Observation::Image(image.try_into().map_err(|e: Error| e.within("observation"))?)
            }
            proto::plan_request::Observed::Position(position) => {
                Observation::Position(position.try_into().map_err(|e: Error| e.within("position"))?)
            }
        };

        let search = request.search.map(Search::try_from).transpose().map_err(|e| e.within("search"))?;
        if search.is_some_and(|search| search.anytime) && request.deadline_ms == 0 {
            return Err(Error::invalid("deadline_ms", "a limit, for a search that goes on until then", 0));
        }

        let approach = request.approach.map(Approach::try_from).transpose().map_err(|e| e.within("approach"))?;
        let other = [("a search", search.is_some()), ("a warm start", !request.warm_start.is_empty())];
        if let Some((other, _)) = other.into_iter().find(|(_, asked)| *asked && approach.is_some()) {
            return Err(Error::invalid("approach", format!("none together with {other}"), "one"));
        }

        Ok(Self {
            model: name("model", request.model)?,
            goal,
            observation,
            seed: request.seed,
            deadline: (request.deadline_ms > 0).then(|| Duration::from_millis(request.deadline_ms.into())),
            model_digest: (!request.model_digest.is_empty())
                .then(|| digest("model_digest", request.model_digest))
                .transpose()?,
            search,
            warm_start: warm_start("warm_start", request.warm_start)?,
            steps_left: request.steps_left.map(|steps| steps_left("steps_left", steps)).transpose()?,
            approach,
        })
    }
}

impl From<PlanRequest> for proto::PlanRequest {
    fn from(request: PlanRequest) -> Self {
        Self {
            model: request.model,
            goal: Some(match request.goal {
                Goal::Id(id) => proto::plan_request::Goal::GoalId(id),
                Goal::Image(image) => proto::plan_request::Goal::GoalImage(image.into()),
                Goal::Position(position) => proto::plan_request::Goal::GoalPosition(position.into()),
            }),
            observed: Some(match request.observation {
                Observation::Image(image) => proto::plan_request::Observed::Observation(image.into()),
                Observation::Position(position) => proto::plan_request::Observed::Position(position.into()),
            }),
            seed: request.seed,
            deadline_ms: request.deadline.map_or(0, |d| u32::try_from(d.as_millis()).unwrap_or(u32::MAX)),
            model_digest: request.model_digest.unwrap_or_default(),
            search: request.search.map(Into::into),
            warm_start: request.warm_start.into_iter().map(|values| proto::Action { values }).collect(),
            steps_left: request.steps_left,
            approach: request.approach.map(Into::into),
        }
    }
}

impl Message for PlanResponse {
    type Proto = proto::PlanResponse;
}

impl TryFrom<proto::PlanResponse> for PlanResponse {
    type Error = Error;

    fn try_from(response: proto::PlanResponse) -> Result<Self, Error> {
        let first_action = response.first_action.ok_or_else(|| Error::missing("first_action"))?;
        let times = response.times.unwrap_or_default();
        Ok(Self {
            actions: actions("actions", response.actions)?,
            first_action: action(first_action).map_err(|e| e.within("first_action"))?,
            inner_losses: response.inner_losses,
            latent_distance: response.latent_distance,
            times: StageTimes {
                queue_seconds: times.queue_seconds,
                encode_seconds: times.encode_seconds,
                plan_seconds: times.plan_seconds,
            },
            model_digest: digest("model_digest", response.model_digest)?,
            goal_id: digest("goal_id", response.goal_id)?,
            iterations: response.iterations,
            iterations_run: response.iterations_run,
            warm_start: actions("warm_start", response.warm_start)?,
            approach: response.approach.map(Approach::try_from).transpose().map_err(|e| e.within("approach"))?,
        })
    }
}

impl From<PlanResponse> for proto::PlanResponse {
    fn from(response: PlanResponse) -> Self {
        let StageTimes { queue_seconds, encode_seconds, plan_seconds } = response.times;
        Self {
            actions: response.actions.into_iter().map(|values| proto::Action { values }).collect(),
            first_action: Some(proto::Action { values: response.first_action }),
            inner_losses: response.inner_losses,
            latent_distance: response.latent_distance,
            times: Some(proto::StageTimes { queue_seconds, encode_seconds, plan_seconds }),
            model_digest: response.model_digest,
            goal_id: response.goal_id,
            iterations: response.iterations,
            iterations_run: response.iterations_run,
            warm_start: response.warm_start.into_iter().map(|values| proto::Action { values }).collect(),
            approach: response.approach.map(Into::into),
        }
    }
}

impl Message for RegisterGoalRequest {
    type Proto = proto::RegisterGoalRequest;
}

impl TryFrom<proto::RegisterGoalRequest> for RegisterGoalRequest {
    type Error = Error;

    fn try_from(request: proto::RegisterGoalRequest) -> Result<Self, Error> {
        Ok(Self { image: required("image", request.image)? })
    }
}

impl From<RegisterGoalRequest> for proto::RegisterGoalRequest {
    fn from(request: RegisterGoalRequest) -> Self {
        Self { image: Some(request.image.into()) }
    }
}

impl Message for RegisterGoalResponse {
    type Proto = proto::RegisterGoalResponse;
}

impl TryFrom<proto::RegisterGoalResponse> for RegisterGoalResponse {
    type Error = Error;

    fn try_from(response: proto::RegisterGoalResponse) -> Result<Self, Error> {
        Ok(Self { goal_id: digest("goal_id", response.goal_id)? })
    }
}

impl From<RegisterGoalResponse> for proto::RegisterGoalResponse {
    fn from(response: RegisterGoalResponse) -> Self {
        Self { goal_id: response.goal_id }
    }
}

impl Message for LoadModelRequest {
    type Proto = proto::LoadModelRequest;
    const MAX_BYTES: usize = 65 << 20;
}

impl TryFrom<proto::LoadModelRequest> for LoadModelRequest {
    type Error = Error;

    fn try_from(request: proto::LoadModelRequest) -> Result<Self, Error> {
        let source = match request.source.ok_or_else(|| Error::missing("source"))? {
            proto::load_model_request::Source::File(file) => CheckpointSource::File(name("file", file)?),
            proto::load_model_request::Source::Checkpoint(bytes) => CheckpointSource::Bytes(bytes),
        };
        Ok(Self { model: name("model", request.model)?, source })
    }
}

impl From<LoadModelRequest> for proto::LoadModelRequest {
    fn from(request: LoadModelRequest) -> Self {
        let source = match request.source {
            CheckpointSource::File(file) => proto::load_model_request::Source::File(file),
            CheckpointSource::Bytes(bytes) => proto::load_model_request::Source::Checkpoint(bytes),
        };
        Self { model: request.model, source: Some(source) }
    }
}

impl Message for LoadModelResponse {
    type Proto = proto::LoadModelResponse;
}

impl TryFrom<proto::LoadModelResponse> for LoadModelResponse {
    type Error = Error;

    fn try_from(response: proto::LoadModelResponse) -> Result<Self, Error> {
        Ok(Self { model: required("model", response.model)? })
    }
}

impl From<LoadModelResponse> for proto::LoadModelResponse {
    fn from(response: LoadModelResponse) -> Self {
        Self { model: Some(response.model.into()) }
    }
}

impl Message for UnloadModelRequest {
    type Proto = proto::UnloadModelRequest;
}

impl TryFrom<proto::UnloadModelRequest> for UnloadModelRequest {
    type Error = Error;

    fn try_from(request: proto::UnloadModelRequest) -> Result<Self, Error> {
        Ok(Self { model: name("model", request.model)? })
    }
}

impl From<UnloadModelRequest> for proto::UnloadModelRequest {
    fn from(request: UnloadModelRequest) -> Self {
        Self { model: request.model }
    }
}

impl Message for UnloadModelResponse {
    type Proto = proto::UnloadModelResponse;
}

impl TryFrom<proto::UnloadModelResponse> for UnloadModelResponse {
    type Error = Error;

    fn try_from(_: proto::UnloadModelResponse) -> Result<Self, Error> {
        Ok(Self)
    }
}

impl From<UnloadModelResponse> for proto::UnloadModelResponse {
    fn from(_: UnloadModelResponse) -> Self {
        Self {}
    }
}

impl Message for ListModelsRequest {
    type Proto = proto::ListModelsRequest;
}

impl TryFrom<proto::ListModelsRequest> for ListModelsRequest {
    type Error = Error;

    fn try_from(_: proto::ListModelsRequest) -> Result<Self, Error> {
        Ok(Self)
    }
}

impl From<ListModelsRequest> for proto::ListModelsRequest {
    fn from(_: ListModelsRequest) -> Self {
        Self {}
    }
}

impl Message for ListModelsResponse {
    type Proto = proto::ListModelsResponse;
    const MAX_BYTES: usize = 16 << 20;
}

impl TryFrom<proto::ListModelsResponse> for ListModelsResponse {
    type Error = Error;

    fn try_from(response: proto::ListModelsResponse) -> Result<Self, Error> {
        let models = response.models.into_iter().map(ModelInfo::try_from).collect::<Result<_, _>>();
        Ok(Self { models: models.map_err(|e| e.within("models"))? })
    }
}

impl From<ListModelsResponse> for proto::ListModelsResponse {
    fn from(response: ListModelsResponse) -> Self {
        Self { models: response.models.into_iter().map(Into::into).collect() }
    }
}

impl TryFrom<proto::ModelInfo> for ModelInfo {
    type Error = Error;

    fn try_from(info: proto::ModelInfo) -> Result<Self, Error> {
        let proto::ModelInfo { name: model, method, digest: sha256, training_tasks, horizon, version } = info;
        let (name, digest) = (name("name", model)?, digest("digest", sha256)?);
        Ok(Self { name, method, digest, training_tasks, horizon, version })
    }
}

impl From<ModelInfo> for proto::ModelInfo {
    fn from(info: ModelInfo) -> Self {
        let ModelInfo { name, method, digest, training_tasks, horizon, version } = info;
        Self { name, method, digest, training_tasks, horizon, version }
    }
}
