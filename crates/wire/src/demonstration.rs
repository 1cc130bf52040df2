//! The demonstration stream, from workers to the trainer, and what a recorder holds of it.

use crate::image::render_spec;
use crate::message::{action, digest as checked_digest, finite, name, position, required};
use crate::sim::Variation;
use crate::{Error, Image, Message, proto};
use sha2::{Digest, Sha256};

/// Most steps of an episode.
pub const MAX_STEPS: u32 = 1000;
/// Most values of a state.
const MAX_STATE: usize = 1024;
/// Most actions in a second of simulated time.
const MAX_CONTROL_HZ: f64 = 10_000.0;

/// One numbered step of an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct DemonstrationStep {
    /// The episode.
    pub episode_id: String,
    /// Its number, from 0.
    pub step: u32,
    /// What the camera showed.
    pub frame: Image,
    /// What the expert did; none at the last step, whose frame is the goal.
    pub action: Option<Vec<f32>>,
    /// What the simulator knows of itself before the action; the hand's x, y, z in metres come first. At most 1024.
    pub state: Vec<f32>,
    /// What the action before this step brought; 0 at the first.
    pub reward: f32,
    /// Whether the task is solved at this step.
    pub success: bool,
}

/// A whole episode, without its steps: as its sender commits it, and as its recording begins.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedEpisode {
    /// The episode.
    pub episode_id: String,
    /// What was demonstrated.
    pub variation: Variation,
    /// Number of steps, goal frame included.
    pub steps: u32,
    /// What [`digest`] gives for the steps.
    pub digest: String,
    /// Where the goal is: x, y, z in metres; empty if it is no position.
    pub goal_position: Vec<f32>,
    /// Actions per second of simulated time.
    pub control_hz: f64,
    /// Of every frame; see [`Image::render_spec`].
    pub render_spec: String,
}

/// A step without its frame, as a recording has it beside; the fields are those of [`DemonstrationStep`].
#[derive(Debug, Clone, PartialEq)]
#[expect(missing_docs, reason = "see DemonstrationStep")]
pub struct RecordedStep {
    pub step: u32,
    pub action: Option<Vec<f32>>,
    pub state: Vec<f32>,
    pub reward: f32,
    pub success: bool,
}

impl RecordedStep {
    /// The step as it was sent.
    pub fn with_frame(self, episode_id: String, frame: Image) -> DemonstrationStep {
        let Self { step, action, state, reward, success } = self;
        DemonstrationStep { episode_id, step, frame, action, state, reward, success }
    }
}

/// Closes an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct CommitEpisodeRequest {
    /// What is to be kept once every step is there.
    pub episode: RecordedEpisode,
}

/// What the receiver still lacks.
#[derive(Debug, Clone, PartialEq)]
pub struct CommitEpisodeResponse {
    /// Steps to send again; none when the episode is kept.
    pub missing_steps: Vec<u32>,
}

/// SHA-256, in hex, over the steps in order, each as pixels, action, state and reward (little-endian 32-bit floats), and
/// one byte that is 1 for success. A step without an action adds nothing for it. A reward of -0 counts as 0, since protobuf
/// keeps no sign of a zero.
pub fn digest<'a>(steps: impl IntoIterator<Item = &'a DemonstrationStep>) -> String {
    let mut hasher = Sha256::new();
    for DemonstrationStep { frame, action, state, reward, success, .. } in steps {
        hasher.update(frame.data());
        for value in action.iter().flatten().chain(state).chain([&(reward + 0.0)]) {
            hasher.update(value.to_le_bytes());
        }
        hasher.update([u8::from(*success)]);
    }
    hex::encode(hasher.finalize())
}

fn step_count(field: &str, value: u32, min: u32, max: u32) -> Result<u32, Error> {
    if (min..=max).contains(&value) { Ok(value) } else { Err(Error::invalid(field, format!("{min} to {max}"), value)) }
}

impl Message for DemonstrationStep {
    type Proto = proto::DemonstrationStep;
}

impl TryFrom<proto::DemonstrationStep> for DemonstrationStep {
    type Error = Error;

    fn try_from(step: proto::DemonstrationStep) -> Result<Self, Error> {
        let proto::DemonstrationStep { episode_id, step, frame, action, state, reward, success } = step;
        let episode_id = name("episode_id", episode_id)?;
        let recorded = RecordedStep::try_from(proto::RecordedStep { step, action, state, reward, success })?;
        Ok(recorded.with_frame(episode_id, required("frame", frame)?))
    }
}

impl From<DemonstrationStep> for proto::DemonstrationStep {
    fn from(step: DemonstrationStep) -> Self {
        let DemonstrationStep { episode_id, step, frame, action, state, reward, success } = step;
        let action = action.map(|values| proto::Action { values });
        Self { episode_id, step, frame: Some(frame.into()), action, state, reward, success }
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
            action: step.action.map(action).transpose().map_err(|e| e.within("action"))?,
            state: finite("state", step.state)?,
            reward: step.reward,
            success: step.success,
        })
    }
}

impl From<RecordedStep> for proto::RecordedStep {
    fn from(step: RecordedStep) -> Self {
        let RecordedStep { step, action, state, reward, success } = step;
        Self { step, action: action.map(|values| proto::Action { values }), state, reward, success }
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
