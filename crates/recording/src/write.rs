//! An episode as the bytes of a file.

use crate::Episode;
use crate::schema::{ENCODING, FRAME_ID, PIXELS, Topic, log_time_nanos};
use foxglove::messages::{RawImage, Timestamp};
use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions, Writer};
use prost::Message;
use std::collections::BTreeMap;
use std::io::Cursor;
use wire::demonstration::{DemonstrationStep, RecordedStep};
use wire::proto;

/// Frames compress against those before them in the same chunk, so that a chunk holds a whole episode of usual length.
const CHUNK_BYTES: u64 = 4 << 20;

/// The recording of an episode. The same episode gives the same bytes.
///
/// # Errors
/// If the encoder fails.
pub fn to_bytes(episode: &Episode) -> Result<Vec<u8>, McapError> {
    let options = WriteOptions::new()
        .library("cpn")
        .chunk_size(Some(CHUNK_BYTES))
        // Threads would only change how the time is spent, and one file takes little.
        .compression_threads(0);
    let mut writer = options.create(Cursor::new(Vec::new()))?;
    let channels = Topic::ALL.map(|topic| {
        let schema = writer.add_schema(&topic.schema_name(), ENCODING, &topic.schema())?;
        writer.add_channel(schema, topic.name(), ENCODING, &BTreeMap::new())
    });
    let [episodes, camera, steps] = channels;
    let (episodes, camera, steps) = (episodes?, camera?, steps?);

    write(&mut writer, episodes, 0, 0, &proto::RecordedEpisode::from(episode.info().clone()))?;
    // The header has a chunk of its own: whoever wants only that need not decompress a frame.
    writer.flush()?;
    for step in episode.steps() {
        let time = log_time_nanos(step.step, episode.info().control_hz);
        write(&mut writer, camera, step.step, time, &raw_image(step, time))?;
        write(&mut writer, steps, step.step, time, &recorded_step(step))?;
    }
    writer.finish()?;
    Ok(writer.into_inner().into_inner())
}

fn write(
    writer: &mut Writer<Cursor<Vec<u8>>>,
    channel_id: u16,
    sequence: u32,
    time: u64,
    message: &impl Message,
) -> Result<(), McapError> {
    let header = MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
    writer.write_to_known_channel(&header, &message.encode_to_vec())
}

fn raw_image(DemonstrationStep { frame, .. }: &DemonstrationStep, time: u64) -> RawImage {
    let seconds = u32::try_from(time / 1_000_000_000).unwrap_or(u32::MAX);
    RawImage {
        timestamp: Some(Timestamp::new(seconds, (time % 1_000_000_000) as u32)),
        frame_id: FRAME_ID.to_owned(),
        width: frame.width(),
        height: frame.height(),
        encoding: PIXELS.to_owned(),
        step: frame.width() * 3,
        data: frame.data().to_vec().into(),
    }
}

fn recorded_step(step: &DemonstrationStep) -> proto::RecordedStep {
    let DemonstrationStep { step, action, state, reward, success, .. } = step.clone();
    RecordedStep { step, action, state, reward, success }.into()
}
