//! What lies beside the frames in a recording.

use crate::demonstration::{DemonstrationStep, MAX_STEPS, RecordedEpisode, step_count};
use crate::image::render_spec;
use crate::message::{action, finite};
use crate::{Error, Image, Message, proto};

/// Most values of a state.
const MAX_STATE: usize = 1024;

/// What is known of a recorded episode besides its steps.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeHeader {
    /// What its sender committed.
    pub episode: RecordedEpisode,
    /// Of every frame; see [`Image::render_spec`].
    pub render_spec: String,
}

/// A step without its frame; the fields are those of [`DemonstrationStep`].
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

impl Message for EpisodeHeader {
    type Proto = proto::EpisodeHeader;
}

impl TryFrom<proto::EpisodeHeader> for EpisodeHeader {
    type Error = Error;

    fn try_from(header: proto::EpisodeHeader) -> Result<Self, Error> {
        let proto::EpisodeHeader { episode_id, variation, render_spec: spec, goal_position, steps, digest, control_hz } =
            header;
        let episode = proto::RecordedEpisode { episode_id, variation, steps, digest, goal_position, control_hz };
        Ok(Self { episode: episode.try_into()?, render_spec: render_spec("render_spec", spec)? })
    }
}

impl From<EpisodeHeader> for proto::EpisodeHeader {
    fn from(header: EpisodeHeader) -> Self {
        let proto::RecordedEpisode { episode_id, variation, steps, digest, goal_position, control_hz } =
            header.episode.into();
        Self { episode_id, variation, render_spec: header.render_spec, goal_position, steps, digest, control_hz }
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
