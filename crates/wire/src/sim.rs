//! Requests and responses of a simulator worker.

use crate::message::{MAX_ACTION, action, required};
use crate::planner::PlanResponse;
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
    /// Position of the hand.
    pub hand_position: Position,
    /// Position of the hand in the goal image.
    pub goal_hand_position: Position,
    /// Whether the task is solved before any action.
    pub success: bool,
    /// Progress towards success before any action, 0 to 1.
    pub progress: f64,
    /// How actions move the hand.
    pub control: Control,
}

/// Control of the hand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Control {
    /// Number of values in an action, 3 to 64. The first three displace the hand along x, y and z.
    pub action_size: u32,
    /// Displacement of the hand's set point by a value of 1, in metres.
    pub metres: f64,
    /// Steps per second of simulated time.
    pub hz: f64,
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
    /// Position of the hand after the action.
    pub hand_position: Position,
    /// Progress towards success after the action, 0 to 1.
    pub progress: f64,
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
            goal_position: match response.goal_position.as_slice() {
                [] => None,
                values => Some(position("goal_position", values)?),
            },
            hand_position: position("hand_position", &response.hand_position)?,
            goal_hand_position: position("goal_hand_position", &response.goal_hand_position)?,
            success: response.success,
            progress: progress(response.progress)?,
            control: required("control", response.control)?,
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
            goal_position: response.goal_position.map(metres).unwrap_or_default(),
            hand_position: metres(response.hand_position),
            goal_hand_position: metres(response.goal_hand_position),
            success: response.success,
            progress: response.progress,
            control: Some(response.control.into()),
        }
    }
}

impl TryFrom<proto::Control> for Control {
    type Error = Error;

    fn try_from(proto::Control { action_size, metres, hz }: proto::Control) -> Result<Self, Error> {
        if !(3..=MAX_ACTION as u32).contains(&action_size) {
            return Err(Error::invalid("action_size", format!("3 to {MAX_ACTION}"), action_size));
        }
        for (field, value) in [("metres", metres), ("hz", hz)] {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::invalid(field, "a finite number above 0", value));
            }
        }
        Ok(Self { action_size, metres, hz })
    }
}

impl From<Control> for proto::Control {
    fn from(Control { action_size, metres, hz }: Control) -> Self {
        Self { action_size, metres, hz }
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
            progress: progress(response.progress)?,
        })
    }
}

impl From<StepResponse> for proto::StepResponse {
    fn from(response: StepResponse) -> Self {
        let StepResponse { observation, reward, success, done, hand_position, progress } = response;
        let (observation, hand_position) = (Some(observation.into()), metres(hand_position));
        Self { observation, reward, success, done, hand_position, progress }
    }
}

/// Validates a position x, y, z in metres.
fn position(field: &str, values: &[f32]) -> Result<Position, Error> {
    match *values {
        [x, y, z] => Position::new([x, y, z]).map_err(|e| e.within(field)),
        _ => Err(Error::invalid(field, "3 values", values.len())),
    }
}

fn metres(position: Position) -> Vec<f32> {
    position.metres().into()
}

fn progress(value: f64) -> Result<f64, Error> {
    // Written so that NaN, which compares false with everything, is refused too.
    if (0.0..=1.0).contains(&value) { Ok(value) } else { Err(Error::invalid("progress", "0 to 1", value)) }
}

/// Plan of a trial, published for watchers.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialPlan {
    /// Identifier of the simulator's episode.
    pub episode_id: String,
    /// Number of steps applied before the plan.
    pub step: u32,
    /// Name of the model.
    pub model: String,
    /// The planner's answer.
    pub plan: PlanResponse,
}

impl Message for TrialPlan {
    type Proto = proto::TrialPlan;
}

impl TryFrom<proto::TrialPlan> for TrialPlan {
    type Error = Error;

    fn try_from(proto::TrialPlan { episode_id, step, model, plan }: proto::TrialPlan) -> Result<Self, Error> {
        Ok(Self { episode_id, step, model: crate::message::name("model", model)?, plan: required("plan", plan)? })
    }
}

impl From<TrialPlan> for proto::TrialPlan {
    fn from(TrialPlan { episode_id, step, model, plan }: TrialPlan) -> Self {
        Self { episode_id, step, model, plan: Some(plan.into()) }
    }
}
