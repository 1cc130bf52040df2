//! Metadata of an episode with recorded plans.

use crate::message::{digest, name, required};
use crate::sim::Variation;
use crate::{Error, Message, Observation, proto};
use proto::planned_episode::Goal;

/// Metadata of an episode with recorded plans: the header of the recording.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedEpisode {
    /// Variation to solve.
    pub variation: Variation,
    /// Name of the model.
    pub model: String,
    /// SHA-256 of the checkpoint that answered, in hex.
    pub model_digest: String,
    /// Goal of all plans; its digest is the goal id of the requests.
    pub goal: Observation,
    /// Number of plans, at least 1.
    pub plans: u32,
}

impl Message for PlannedEpisode {
    type Proto = proto::PlannedEpisode;
}

impl TryFrom<proto::PlannedEpisode> for PlannedEpisode {
    type Error = Error;

    fn try_from(episode: proto::PlannedEpisode) -> Result<Self, Error> {
        if episode.plans == 0 {
            return Err(Error::invalid("plans", "at least 1", 0));
        }
        Ok(Self {
            variation: required("variation", episode.variation)?,
            model: name("model", episode.model)?,
            model_digest: digest("model_digest", episode.model_digest)?,
            goal: match episode.goal.ok_or_else(|| Error::missing("goal"))? {
                Goal::GoalImage(image) => {
                    Observation::Image(image.try_into().map_err(|e: Error| e.within("goal_image"))?)
                }
                Goal::GoalPosition(position) => {
                    Observation::Position(position.try_into().map_err(|e: Error| e.within("goal_position"))?)
                }
            },
            plans: episode.plans,
        })
    }
}

impl From<PlannedEpisode> for proto::PlannedEpisode {
    fn from(episode: PlannedEpisode) -> Self {
        let PlannedEpisode { variation, model, model_digest, goal, plans } = episode;
        let goal = match goal {
            Observation::Image(image) => Goal::GoalImage(image.into()),
            Observation::Position(position) => Goal::GoalPosition(position.into()),
        };
        Self { variation: Some(variation.into()), model, model_digest, goal: Some(goal), plans }
    }
}
