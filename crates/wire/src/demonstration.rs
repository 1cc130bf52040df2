//! The demonstration stream, from workers to the trainer.

use crate::message::{action, name, required};
use crate::sim::Variation;
use crate::{Error, Image, Message, proto};

/// Most steps of an episode.
pub const MAX_STEPS: u32 = 1000;

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
}

/// Closes an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct CommitEpisodeRequest {
    /// The episode.
    pub episode_id: String,
    /// What was demonstrated.
    pub variation: Variation,
    /// Number of steps, goal frame included.
    pub steps: u32,
}

/// What the receiver still lacks.
#[derive(Debug, Clone, PartialEq)]
pub struct CommitEpisodeResponse {
    /// Steps to send again; none when the episode is kept.
    pub missing_steps: Vec<u32>,
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
        Ok(Self {
            episode_id: name("episode_id", step.episode_id)?,
            step: step_count("step", step.step, 0, MAX_STEPS - 1)?,
            frame: required("frame", step.frame)?,
            action: step.action.map(action).transpose().map_err(|e| e.within("action"))?,
        })
    }
}

impl From<DemonstrationStep> for proto::DemonstrationStep {
    fn from(step: DemonstrationStep) -> Self {
        Self {
            episode_id: step.episode_id,
            step: step.step,
            frame: Some(step.frame.into()),
            action: step.action.map(|values| proto::Action { values }),
        }
    }
}

impl Message for CommitEpisodeRequest {
    type Proto = proto::CommitEpisodeRequest;
}

impl TryFrom<proto::CommitEpisodeRequest> for CommitEpisodeRequest {
    type Error = Error;

    fn try_from(request: proto::CommitEpisodeRequest) -> Result<Self, Error> {
        Ok(Self {
            episode_id: name("episode_id", request.episode_id)?,
            variation: required("variation", request.variation)?,
            steps: step_count("steps", request.steps, 2, MAX_STEPS)?,
        })
    }
}

impl From<CommitEpisodeRequest> for proto::CommitEpisodeRequest {
    fn from(request: CommitEpisodeRequest) -> Self {
        Self { episode_id: request.episode_id, variation: Some(request.variation.into()), steps: request.steps }
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
