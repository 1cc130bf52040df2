//! Encoding of episodes.

use crate::Episode;
use crate::camera::raw_image;
use crate::file::Writer;
use crate::topic::{Topic, log_time_nanos};
use mcap::McapError;
use wire::demonstration::{DemonstrationStep, RecordedStep};
use wire::proto;

/// Encodes the recording of an episode, deterministically.
///
/// # Errors
/// If the encoder fails.
pub fn to_bytes(episode: &Episode) -> Result<Vec<u8>, McapError> {
    let mut writer = Writer::new(&[Topic::Episode, Topic::Camera, Topic::Step])?;
    writer.write(Topic::Episode, 0, 0, &proto::RecordedEpisode::from(episode.info().clone()))?;
    // The header has a chunk of its own, so that it can be read without decompressing a frame.
    writer.end_chunk()?;
    for step in episode.steps() {
        let time = log_time_nanos(step.step, episode.info().control_hz);
        writer.write(Topic::Camera, step.step, time, &raw_image(&step.frame, time))?;
        writer.write(Topic::Step, step.step, time, &recorded_step(step))?;
    }
    writer.finish()
}

fn recorded_step(step: &DemonstrationStep) -> proto::RecordedStep {
    let DemonstrationStep { step, action, applied_action, state, reward, success, .. } = step.clone();
    RecordedStep { step, action, applied_action, state, reward, success }.into()
}
