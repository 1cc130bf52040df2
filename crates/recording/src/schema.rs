//! Topics, schemas and times of a recording.

use foxglove::Encode;
use foxglove::messages::RawImage;
use prost::{Message as _, Name};
use prost_types::FileDescriptorSet;
use wire::proto;

/// How messages and schemas are encoded.
pub(crate) const ENCODING: &str = "protobuf";
/// How pixels are laid out, in the words of [`RawImage`].
pub(crate) const PIXELS: &str = "rgb8";
/// Name of the camera's frame of reference.
pub(crate) const FRAME_ID: &str = "camera";

/// Which messages are where.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Topic {
    /// `cpn.v1.RecordedEpisode`, first and once.
    Episode,
    /// `foxglove.RawImage`, before the step of the same time.
    Camera,
    /// `cpn.v1.RecordedStep`.
    Step,
}

impl Topic {
    pub(crate) const ALL: [Self; 3] = [Self::Episode, Self::Camera, Self::Step];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Episode => "/episode",
            Self::Camera => "/camera",
            Self::Step => "/step",
        }
    }

    /// Full name of the topic's message.
    pub(crate) fn schema_name(self) -> String {
        match self {
            Self::Episode => proto::RecordedEpisode::full_name(),
            Self::Camera => schema_of_camera().name,
            Self::Step => proto::RecordedStep::full_name(),
        }
    }

    /// The message and everything it refers to, as a `FileDescriptorSet`.
    pub(crate) fn schema(self) -> Vec<u8> {
        match self {
            Self::Camera => schema_of_camera().data.into_owned(),
            Self::Episode | Self::Step => schema_of_recordings(),
        }
    }
}

fn schema_of_camera() -> foxglove::Schema {
    RawImage::get_schema().expect("every message of Foxglove has a schema")
}

/// The two files that recordings need, so that a change of any other leaves recordings as they are.
fn schema_of_recordings() -> Vec<u8> {
    let mut all = FileDescriptorSet::decode(proto::DESCRIPTORS).expect("the build script encoded them");
    all.file.retain(|file| matches!(file.name(), "cpn/v1/types.proto" | "cpn/v1/demonstration.proto"));
    all.encode_to_vec()
}

/// When a step is, in nanoseconds since the start of the episode.
pub(crate) fn log_time_nanos(step: u32, control_hz: f64) -> u64 {
    (f64::from(step) * 1e9 / control_hz).round() as u64
}
