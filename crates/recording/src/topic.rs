//! Topics, schemas and log times of recordings.

use foxglove::Encode;
use foxglove::messages::RawImage;
use prost::{Message as _, Name};
use prost_types::FileDescriptorSet;
use wire::proto;

/// Encoding of messages and schemas.
pub(crate) const ENCODING: &str = "protobuf";

/// Topics, each with its message type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Topic {
    /// `cpn.v1.RecordedEpisode`, first and once.
    Episode,
    /// `foxglove.RawImage`, before the step or the plan request of the same number.
    Camera,
    /// `cpn.v1.RecordedStep`.
    Step,
    /// `cpn.v1.RecordedTrial`, first and once.
    Trial,
    /// `cpn.v1.PlanRequest`.
    PlanRequest,
    /// `cpn.v1.PlanResponse`, after its request.
    PlanResponse,
}

impl Topic {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Episode | Self::Trial => "/episode",
            Self::Camera => "/camera",
            Self::Step => "/step",
            Self::PlanRequest => "/plan/request",
            Self::PlanResponse => "/plan/response",
        }
    }

    /// Full name of the topic's message.
    pub(crate) fn schema_name(self) -> String {
        match self {
            Self::Episode => proto::RecordedEpisode::full_name(),
            Self::Camera => schema_of_camera().name,
            Self::Step => proto::RecordedStep::full_name(),
            Self::Trial => proto::RecordedTrial::full_name(),
            Self::PlanRequest => proto::PlanRequest::full_name(),
            Self::PlanResponse => proto::PlanResponse::full_name(),
        }
    }

    /// Encoded `FileDescriptorSet` of the message and the types it refers to.
    pub(crate) fn schema(self) -> Vec<u8> {
        match self {
            Self::Camera => schema_of_camera().data.into_owned(),
            Self::Episode | Self::Step => schema_of("cpn/v1/demonstration.proto"),
            Self::Trial => schema_of("cpn/v1/trial.proto"),
            Self::PlanRequest | Self::PlanResponse => schema_of("cpn/v1/planner.proto"),
        }
    }
}

fn schema_of_camera() -> foxglove::Schema {
    RawImage::get_schema().expect("every message of Foxglove has a schema")
}

/// Schema of one `.proto` file and its imports alone, so that changes of other files leave recordings as they are.
fn schema_of(file_name: &str) -> Vec<u8> {
    let mut all = FileDescriptorSet::decode(proto::DESCRIPTORS).expect("the build script encoded them");
    all.file.retain(|file| ["cpn/v1/types.proto", file_name].contains(&file.name()));
    all.encode_to_vec()
}

/// Time of a step, in nanoseconds since the start of the episode.
pub(crate) fn log_time_nanos(step: u32, control_hz: f64) -> u64 {
    (f64::from(step) * 1e9 / control_hz).round() as u64
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;

    /// A reader in another language builds the messages from the schema alone.
    #[test]
    fn schemas_have_every_import() {
        for topic in [Topic::Episode, Topic::Camera, Topic::Step, Topic::Trial, Topic::PlanRequest, Topic::PlanResponse]
        {
            let set = FileDescriptorSet::decode(&topic.schema()[..]).unwrap();
            for (at, file) in set.file.iter().enumerate() {
                for import in &file.dependency {
                    assert!(set.file[..at].iter().any(|file| file.name() == import), "{}: {import}", topic.name());
                }
            }
        }
    }
}
