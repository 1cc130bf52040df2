//! Recordings: no input makes the reader panic, and recordings that are read round-trip.

#![no_main]

use libfuzzer_sys::fuzz_target;
use mcap::records::MessageHeader;
use mcap::{Compression, McapError, Message, MessageStream, WriteOptions};
use recording::trial::{self, Exchange, Frame, Recording};
use recording::{Episode, ReadError};
use std::io::Cursor;
use std::time::Duration;
use wire::demonstration::{DemonstrationStep, RecordedEpisode, digest};
use wire::planner::{Approach, Goal, PlanRequest, PlanResponse, StageTimes};
use wire::sim::Variation;
use wire::trial::RecordedTrial;
use wire::{Image, Position};

fuzz_target!(init: fuzz::seed("recording", recordings(), check), |input: &[u8]| {
    let _ = check(input);
});

fn check(input: &[u8]) -> Result<(), ReadError> {
    let demonstration = round_trip(input, recording::from_bytes, recording::to_bytes);
    demonstration.or_else(|_| round_trip(input, trial::from_bytes, trial::to_bytes))
}

/// Checks a round trip. Bytes are compared, since plans may contain NaN.
fn round_trip<T>(
    input: &[u8],
    read: fn(&[u8]) -> Result<T, ReadError>,
    write: fn(&T) -> Result<Vec<u8>, McapError>,
) -> Result<(), ReadError> {
    let copy = write(&read(input)?).expect("what was read can be written");
    let same = read(&copy).expect("what was written can be read");
    assert_eq!(write(&same).expect("what was read can be written"), copy);
    Ok(())
}

/// Recordings as written, and copies without checksums, which allow mutations.
fn recordings() -> Vec<Vec<u8>> {
    let demonstration = recording::to_bytes(&demonstration()).expect("an episode can be written");
    let [images, positions] =
        [trial(None), trial(Some(position()))].map(|it| trial::to_bytes(&it).expect("a trial can be written"));
    [demonstration, images, positions]
        .into_iter()
        .flat_map(|whole| [flat(&whole), chunked(&whole), compressed(&whole), whole])
        .collect()
}

fn flat(recording: &[u8]) -> Vec<u8> {
    copy(recording, WriteOptions::new().use_chunks(false))
}

fn chunked(recording: &[u8]) -> Vec<u8> {
    copy(recording, WriteOptions::new().compression(None))
}

fn compressed(recording: &[u8]) -> Vec<u8> {
    copy(recording, WriteOptions::new().compression(Some(Compression::Zstd)))
}

fn copy(recording: &[u8], options: WriteOptions) -> Vec<u8> {
    let options = options.calculate_chunk_crcs(false).calculate_data_section_crc(false);
    let options = options.calculate_summary_section_crc(false).emit_summary_records(false);
    let mut writer = options.create(Cursor::new(Vec::new())).expect("a writer");
    for message in MessageStream::new(recording).expect("a recording") {
        let Message { channel, sequence, log_time, publish_time, data } = message.expect("a message");
        let schema = channel.schema.as_ref().expect("a schema");
        // Without the schema's text, which the reader ignores and which would be most of the file.
        let schema = writer.add_schema(&schema.name, &schema.encoding, &[]).expect("a schema");
        let encoding = &channel.message_encoding;
        let channel_id = writer.add_channel(schema, &channel.topic, encoding, &channel.metadata).expect("a channel");
        let header = MessageHeader { channel_id, sequence, log_time, publish_time };
        writer.write_to_known_channel(&header, &data).expect("a vector takes all bytes");
    }
    writer.finish().expect("a vector takes all bytes");
    writer.into_inner().into_inner()
}

fn demonstration() -> Episode {
    let step = |step: u32| DemonstrationStep {
        episode_id: "reach-5".into(),
        step,
        frame: image(step as u8),
        action: (step < 2).then(|| vec![0.25, -1.0]),
        applied_action: (step == 1).then(|| vec![0.5, 1.0]),
        state: vec![0.5],
        reward: 1.0,
        success: step == 2,
    };
    let steps: Vec<_> = (0..3).map(step).collect();
    let info = RecordedEpisode {
        episode_id: "reach-5".into(),
        variation: variation(),
        steps: 3,
        digest: digest(&steps),
        goal_position: vec![0.0, 0.5, 0.25],
        control_hz: 80.0,
        render_spec: String::new(),
    };
    Episode::new(info, steps).expect("an episode")
}

/// Trial with two plans, from images or positions.
fn trial(goal_position: Option<Position>) -> Recording {
    let model_digest = "0".repeat(64);
    let trial = RecordedTrial {
        variation: variation(),
        model: "cpn".into(),
        model_digest: model_digest.clone(),
        goal: image(9),
        goal_position,
        steps: 3,
        plans: 2,
    };
    let response = PlanResponse {
        actions: vec![vec![0.25, -1.0]; 2],
        first_action: vec![0.25, -1.0],
        inner_losses: vec![0.5, 0.25],
        latent_distance: Some(1.5),
        times: StageTimes { queue_seconds: 0.1, encode_seconds: 0.2, plan_seconds: 0.3 },
        model_digest,
        goal_id: "0".repeat(64),
        iterations: 1,
        iterations_run: 1,
        warm_start: Vec::new(),
        approach: Some(Approach { tried: 1, position: [0.5; 3], plans: 2 }),
    };
    let goal = || goal_position.map_or_else(|| Goal::Id(image(9).digest()), Goal::Position);
    let exchange = |step: u32| Exchange {
        step,
        request: PlanRequest::new("cpn", goal(), goal_position.map_or_else(|| image(step as u8).into(), Into::into)),
        asked: Duration::from_millis(1),
        response: response.clone(),
        answered: Duration::from_millis(2),
    };
    let frame = |step: u8| Frame { image: image(step), time: Duration::from_millis(step.into()) };
    Recording::new(trial, (0..4).map(frame).collect(), [0, 2].map(exchange).into()).expect("a trial that fits together")
}

fn image(shade: u8) -> Image {
    Image::new(1, 2, vec![shade; 6]).expect("an image")
}

fn position() -> Position {
    Position::new([0.5, -0.25, 0.125]).expect("a position")
}

fn variation() -> Variation {
    Variation { task: "reach".into(), seed: 5 }
}
