//! Requests and responses of a simulator worker.

use crate::message::{action, required};
use crate::{Error, Image, Message, Position, proto};

/// Randomised initial state of an episode.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Variation {
    /// Name of the task.
    pub task: String,
    /// Seed of the positions of objects and goal.
    pub seed: u64,
}

/// Request to start an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct ResetRequest {
    /// Variation to start.
    pub variation: Variation,
    /// Seed of the variation that the goal is taken from; that of `variation` if none. Any other is an ablation.
    pub goal_seed: Option<u64>,
}

/// Started episode.
#[derive(Debug, Clone, PartialEq)]
pub struct ResetResponse {
    /// Identifier of the episode in its step requests.
    pub episode_id: String,
    /// Last frame of an expert episode of the same variation.
    pub goal: Image,
    /// First frame.
    pub observation: Image,
    /// Step limit of the episode.
    pub max_steps: u32,
    /// Goal position, if the goal is one.
    pub goal_position: Option<Position>,
    /// Position of the hand, if the goal is a position.
    pub hand_position: Option<Position>,
}

/// Request to apply one action, exactly once.
#[derive(Debug, Clone, PartialEq)]
pub struct StepRequest {
    /// Identifier of the episode.
    pub episode_id: String,
    /// Number of steps applied before this one.
    pub step: u32,
    /// Action, each value in [-1, 1].
    pub action: Vec<f32>,
}

/// Outcome of an action.
#[derive(Debug, Clone, PartialEq)]
pub struct StepResponse {
    /// Frame after the action.
    pub observation: Image,
    /// Meta-World's reward.
    pub reward: f64,
    /// Whether the task is solved, at this step or any before it.
    pub success: bool,
    /// Whether the episode is over.
    pub done: bool,
    /// Position of the hand after the action, if the goal is a position.
    pub hand_position: Option<Position>,
}

impl TryFrom<proto::Variation> for Variation {
    type Error = Error;

    fn try_from(variation: proto::Variation) -> Result<Self, Error> {
        Ok(Self { task: crate::message::name("task", variation.task)?, seed: variation.seed })
    }
}

impl From<Variation> for proto::Variation {
    fn from(variation: Variation) -> Self {
        Self { task: variation.task, seed: variation.seed }
    }
}

impl Message for ResetRequest {
    type Proto = proto::ResetRequest;
}

impl TryFrom<proto::ResetRequest> for ResetRequest {
    type Error = Error;

    fn try_from(request: proto::ResetRequest) -> Result<Self, Error> {
        Ok(Self { variation: required("variation", request.variation)?, goal_seed: request.goal_seed })
    }
}

impl From<ResetRequest> for proto::ResetRequest {
    fn from(request: ResetRequest) -> Self {
        Self { variation: Some(request.variation.into()), goal_seed: request.goal_seed }
    }
}

impl Message for ResetResponse {
    type Proto = proto::ResetResponse;
}

impl TryFrom<proto::ResetResponse> for ResetResponse {
    type Error = Error;

    fn try_from(response: proto::ResetResponse) -> Result<Self, Error> {
        Ok(Self {
            episode_id: response.episode_id,
            goal: required("goal", response.goal)?,
            observation: required("observation", response.observation)?,
            max_steps: response.max_steps,
            goal_position: position("goal_position", &response.goal_position)?,
            hand_position: position("hand_position", &response.hand_position)?,
        })
    }
}

impl From<ResetResponse> for proto::ResetResponse {
    fn from(response: ResetResponse) -> Self {
        Self {
            episode_id: response.episode_id,
            goal: Some(response.goal.into()),
            observation: Some(response.observation.into()),
            max_steps: response.max_steps,
            goal_position: metres(response.goal_position),
            hand_position: metres(response.hand_position),
        }
    }
}

impl Message for StepRequest {
    type Proto = proto::StepRequest;
}

impl TryFrom<proto::StepRequest> for StepRequest {
    type Error = Error;

    fn try_from(request: proto::StepRequest) -> Result<Self, Error> {
        let values = request.action.ok_or_else(|| Error::missing("action"))?;
        Ok(Self {
            episode_id: request.episode_id,
            step: request.step,
            action: action(values).map_err(|e| e.within("action"))?,
        })
    }
}

impl From<StepRequest> for proto::StepRequest {
    fn from(request: StepRequest) -> Self {
        Self {
            episode_id: request.episode_id,
            step: request.step,
            action: Some(proto::Action { values: request.action }),
        }
    }
}

impl Message for StepResponse {
    type Proto = proto::StepResponse;
}

impl TryFrom<proto::StepResponse> for StepResponse {
    type Error = Error;

    fn try_from(response: proto::StepResponse) -> Result<Self, Error> {
        Ok(Self {
            observation: required("observation", response.observation)?,
            reward: response.reward,
            success: response.success,
            done: response.done,
            hand_position: position("hand_position", &response.hand_position)?,
        })
    }
}

impl From<StepResponse> for proto::StepResponse {
    fn from(response: StepResponse) -> Self {
        let StepResponse { observation, reward, success, done, hand_position } = response;
        Self { observation: Some(observation.into()), reward, success, done, hand_position: metres(hand_position) }
    }
}

/// Validates a position x, y, z in metres, or no values for none.
fn position(field: &str, values: &[f32]) -> Result<Option<Position>, Error> {
    match *values {
        [] => Ok(None),
        [x, y, z] => Position::new([x, y, z]).map(Some).map_err(|e| e.within(field)),
        _ => Err(Error::invalid(field, "0 or 3 values", values.len())),
    }
}

fn metres(position: Option<Position>) -> Vec<f32> {
    position.map(Position::metres).into_iter().flatten().collect()
}
