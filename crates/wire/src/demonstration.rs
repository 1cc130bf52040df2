//! Demonstration stream, from workers to the trainer, and recorded demonstrations.

use crate::image::render_spec;
use crate::message::{action, digest as checked_digest, finite, name, position, required};
use crate::sim::Variation;
use crate::{Error, Image, Message, proto};
use sha2::{Digest, Sha256};

/// Maximum number of steps of an episode.
pub const MAX_STEPS: u32 = 1000;
/// Maximum length of a state vector.
const MAX_STATE: usize = 1024;
/// Highest control rate, in actions per second of simulated time.
const MAX_CONTROL_HZ: f64 = 10_000.0;

/// One numbered step of an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct DemonstrationStep {
    /// Identifier of the episode.
    pub episode_id: String,
    /// Step number, from 0.
    pub step: u32,
    /// Camera image before the action.
    pub frame: Image,
    /// Action of the demonstrator; none at the last step, whose frame is the goal.
    pub action: Option<Vec<f32>>,
    /// Action that was applied, if it is another: with noise added.
    pub applied_action: Option<Vec<f32>>,
    /// Simulator state before the action, at most 1024 values; the hand's x, y, z in metres come first.
    pub state: Vec<f32>,
    /// Reward of the previous action; 0 at the first step.
    pub reward: f32,
    /// Whether the task is solved at this step.
    pub success: bool,
}

/// Metadata of a complete episode: committed by its sender, and the header of its recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedEpisode {
    /// Identifier of the episode.
    pub episode_id: String,
    /// Demonstrated variation.
    pub variation: Variation,
    /// Number of steps, goal frame included.
    pub steps: u32,
    /// SHA-256 of the steps, in hex; see [`digest`].
    pub digest: String,
    /// Goal position x, y, z in metres; empty if the goal is no position.
    pub goal_position: Vec<f32>,
    /// Control rate, in actions per second of simulated time.
    pub control_hz: f64,
    /// Render spec of every frame; see [`Image::render_spec`].
    pub render_spec: String,
}

/// Step without its frame, which a recording stores separately; the fields are those of [`DemonstrationStep`].
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "see DemonstrationStep")]
pub struct RecordedStep {
    pub step: u32,
    pub action: Option<Vec<f32>>,
    pub applied_action: Option<Vec<f32>>,
    pub state: Vec<f32>,
    pub reward: f32,
    pub success: bool,
}

impl RecordedStep {
    /// Full step, with the episode's identifier and the frame.
    pub fn with_frame(self, episode_id: String, frame: Image) -> DemonstrationStep {
        let Self { step, action, applied_action, state, reward, success } = self;
        DemonstrationStep { episode_id, step, frame, action, applied_action, state, reward, success }
    }
}

/// Request to store an episode once every step has arrived.
#[derive(Debug, Clone, PartialEq)]
pub struct CommitEpisodeRequest {
    /// Metadata of the episode.
    pub episode: RecordedEpisode,
}

/// Steps that the recorder has not received.
#[derive(Debug, Clone, PartialEq)]
pub struct CommitEpisodeResponse {
    /// Numbers of the steps to send again; empty once the episode is stored.
    pub missing_steps: Vec<u32>,
}

/// SHA-256, in hex, over the steps in order: each step's pixels, then action, applied action, state and reward as
/// little-endian 32-bit floats, then one byte for success (1 or 0). A missing action adds no bytes. A reward of -0 counts as 0,
/// since protobuf drops the sign of a zero.
pub fn digest<'a>(steps: impl IntoIterator<Item = &'a DemonstrationStep>) -> String {
    let mut hasher = Sha256::new();
    for DemonstrationStep { frame, action, applied_action, state, reward, success, .. } in steps {
        hasher.update(frame.data());
        let actions = action.iter().chain(applied_action).flatten();
        for value in actions.chain(state).chain([&(reward + 0.0)]) {
            hasher.update(value.to_le_bytes());
        }
        hasher.update([u8::from(*success)]);
    }
    hex::encode(hasher.finalize())
}

fn step_count(field: &str, value: u32, min: u32, max: u32) -> Result<u32, Error> {
    if (min..=max).contains(&value) { Ok(value) } else { Err(Error::invalid(field, format!("{min} to {max}"), value)) }
}

fn optional_action(field: &str, value: Option<proto::Action>) -> Result<Option<Vec<f32>>, Error> {
    value.map(action).transpose().map_err(|e| e.within(field))
}

impl Message for DemonstrationStep {
    type Proto = proto::DemonstrationStep;
}

impl TryFrom<proto::DemonstrationStep> for DemonstrationStep {
    type Error = Error;

    fn try_from(step: proto::DemonstrationStep) -> Result<Self, Error> {
        let proto::DemonstrationStep { episode_id, step, frame, action, applied_action, state, reward, success } = step;
        let episode_id = name("episode_id", episode_id)?;
        let recorded =
            RecordedStep::try_from(proto::RecordedStep { step, action, applied_action, state, reward, success })?;
        Ok(recorded.with_frame(episode_id, required("frame", frame)?))
    }
}

impl From<DemonstrationStep> for proto::DemonstrationStep {
    fn from(step: DemonstrationStep) -> Self {
        let DemonstrationStep { episode_id, step, frame, action, applied_action, state, reward, success } = step;
        let [action, applied_action] =
            [action, applied_action].map(|action| action.map(|values| proto::Action { values }));
        Self { episode_id, step, frame: Some(frame.into()), action, applied_action, state, reward, success }
    }
}

impl Message for RecordedStep {
    type Proto = proto::RecordedStep;
}

impl TryFrom<proto::RecordedStep> for RecordedStep {
    type Error = Error;

    fn try_from(step: proto::RecordedStep) -> Result<Self, Error> {
        if step.state.len() > MAX_STATE {
            return Err(Error::invalid("state", format!("at most {MAX_STATE} values"), step.state.len()));
        }
        if !step.reward.is_finite() {
            return Err(Error::invalid("reward", "a finite number", step.reward));
        }
        Ok(Self {
            step: step_count("step", step.step, 0, MAX_STEPS - 1)?,
            action: optional_action("action", step.action)?,
            applied_action: optional_action("applied_action", step.applied_action)?,
            state: finite("state", step.state)?,
            reward: step.reward,
            success: step.success,
        })
    }
}

impl From<RecordedStep> for proto::RecordedStep {
    fn from(step: RecordedStep) -> Self {
        let RecordedStep { step, action, applied_action, state, reward, success } = step;
        let [action, applied_action] =
            [action, applied_action].map(|action| action.map(|values| proto::Action { values }));
        Self { step, action, applied_action, state, reward, success }
    }
}

impl Message for RecordedEpisode {
    type Proto = proto::RecordedEpisode;
}

impl TryFrom<proto::RecordedEpisode> for RecordedEpisode {
    type Error = Error;

    fn try_from(episode: proto::RecordedEpisode) -> Result<Self, Error> {
        let control_hz = episode.control_hz;
        if !(control_hz > 0.0 && control_hz <= MAX_CONTROL_HZ) {
            return Err(Error::invalid("control_hz", format!("above 0, at most {MAX_CONTROL_HZ}"), control_hz));
        }
        Ok(Self {
            episode_id: name("episode_id", episode.episode_id)?,
            variation: required("variation", episode.variation)?,
            steps: step_count("steps", episode.steps, 2, MAX_STEPS)?,
            digest: checked_digest("digest", episode.digest)?,
            goal_position: position("goal_position", episode.goal_position)?,
            control_hz,
            render_spec: render_spec("render_spec", episode.render_spec)?,
        })
    }
}

impl From<RecordedEpisode> for proto::RecordedEpisode {
    fn from(episode: RecordedEpisode) -> Self {
        let RecordedEpisode { episode_id, variation, steps, digest, goal_position, control_hz, render_spec } = episode;
        Self { episode_id, variation: Some(variation.into()), steps, digest, goal_position, control_hz, render_spec }
    }
}

impl Message for CommitEpisodeRequest {
    type Proto = proto::CommitEpisodeRequest;
}

impl TryFrom<proto::CommitEpisodeRequest> for CommitEpisodeRequest {
    type Error = Error;

    fn try_from(request: proto::CommitEpisodeRequest) -> Result<Self, Error> {
        Ok(Self { episode: required("episode", request.episode)? })
    }
}

impl From<CommitEpisodeRequest> for proto::CommitEpisodeRequest {
    fn from(request: CommitEpisodeRequest) -> Self {
        Self { episode: Some(request.episode.into()) }
    }
}

impl Message for CommitEpisodeResponse {
    type Proto = proto::CommitEpisodeResponse;
}

impl TryFrom<proto::CommitEpisodeResponse> for CommitEpisodeResponse {
    type Error = Error;

    fn try_from(response: proto::CommitEpisodeResponse) -> Result<Self, Error> {
        Ok(Self { missing_steps: response.missing_steps })
    }
}

impl From<CommitEpisodeResponse> for proto::CommitEpisodeResponse {
    fn from(response: CommitEpisodeResponse) -> Self {
        Self { missing_steps: response.missing_steps }
    }
}
