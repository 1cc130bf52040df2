//! Metadata of a recorded trial.

use crate::message::{digest, name, required};
use crate::sim::Variation;
use crate::{Error, Image, Message, Observation, Position, proto};

/// Metadata of a trial, an attempt at a variation by a model or a control: the header of its recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedTrial {
    /// Variation to solve.
    pub variation: Variation,
    /// Name of the model or control.
    pub model: String,
    /// SHA-256 of the checkpoint that answered, in hex; empty for a control.
    pub model_digest: String,
    /// Image of the finished task, with the render spec of every frame.
    pub goal: Image,
    /// Goal of the plans in place of the image, if the task has positions as goals.
    pub goal_position: Option<Position>,
    /// Number of actions applied, at least 1; there is one more frame.
    pub steps: u32,
    /// Number of plans; none of a control.
    pub plans: u32,
}

impl RecordedTrial {
    /// Goal of all plans; its digest is the goal id of the requests.
    pub fn planned_goal(&self) -> Observation {
        self.goal_position.map_or_else(|| self.goal.clone().into(), Observation::from)
    }
}

impl Message for RecordedTrial {
    type Proto = proto::RecordedTrial;
}

impl TryFrom<proto::RecordedTrial> for RecordedTrial {
    type Error = Error;

    fn try_from(trial: proto::RecordedTrial) -> Result<Self, Error> {
        let proto::RecordedTrial { variation, model, model_digest, goal, goal_position, steps, plans } = trial;
        if steps == 0 {
            return Err(Error::invalid("steps", "at least 1", 0));
        }
        let model_digest =
            if plans == 0 && model_digest.is_empty() { model_digest } else { digest("model_digest", model_digest)? };
        Ok(Self {
            variation: required("variation", variation)?,
            model: name("model", model)?,
            model_digest,
            goal: required("goal", goal)?,
            goal_position: goal_position.map(Position::try_from).transpose().map_err(|e| e.within("goal_position"))?,
            steps,
            plans,
        })
    }
}

impl From<RecordedTrial> for proto::RecordedTrial {
    fn from(trial: RecordedTrial) -> Self {
        let RecordedTrial { variation, model, model_digest, goal, goal_position, steps, plans } = trial;
        Self {
            variation: Some(variation.into()),
            model,
            model_digest,
            goal: Some(goal.into()),
            goal_position: goal_position.map(Into::into),
            steps,
            plans,
        }
    }
}
