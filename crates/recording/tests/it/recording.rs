//! Round trip of recordings, and refusals of damaged ones.

use foxglove::messages::RawImage;
use mcap::records::{MessageHeader, op};
use mcap::{MessageStream, WriteOptions, Writer};
use proptest::prelude::*;
use prost::Message as _;
use recording::{Episode, ReadError, from_bytes, to_bytes};
use std::borrow::Cow;
use std::io::Cursor;
use wire::demonstration::{DemonstrationStep, RecordedEpisode, digest};
use wire::sim::Variation;
use wire::{Image, proto};

/// Steps of an episode with small images.
fn steps(count: u32, side: u32, spec: &str) -> Vec<DemonstrationStep> {
    let step = |step: u32| {
        let pixels = (0..side * side * 3).map(|i| (i * 31 + step * 7) as u8).collect();
        DemonstrationStep {
            episode_id: "reach-5".into(),
            step,
            frame: Image::new(side, side, pixels).unwrap().rendered_as(spec).unwrap(),
            action: (step + 1 < count).then(|| vec![0.25, -1.0, step as f32 / 1000.0]),
            applied_action: (step == 1 && step + 1 < count).then(|| vec![-0.25, 1.0, 0.5]),
            state: vec![step as f32, 0.5],
            reward: step as f32 * 0.1,
            success: step + 1 == count,
        }
    };
    (0..count).map(step).collect()
}

fn info(steps: &[DemonstrationStep]) -> RecordedEpisode {
    RecordedEpisode {
        episode_id: "reach-5".into(),
        variation: Variation { task: "reach".into(), seed: 5 },
        steps: steps.len() as u32,
        digest: digest(steps),
        goal_position: vec![0.0, 0.5, 0.25],
        control_hz: 80.0,
        render_spec: steps[0].frame.render_spec().to_owned(),
    }
}

fn episode(count: u32, side: u32) -> Episode {
    let steps = steps(count, side, r#"{"camera":"corner"}"#);
    Episode::new(info(&steps), steps).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn an_episode_round_trips(
        count in 2u32..7,
        (height, width) in (1u32..9, 1u32..9),
        spec in "\\PC{0,30}",
        seed in any::<u8>(),
        has_goal in any::<bool>(),
        control_hz in 0.5..200.0,
    ) {
        let mut steps = steps(count, 1, "");
        for step in &mut steps {
            let pixels = (0..height * width * 3).map(|i| (i as u8).wrapping_mul(seed)).collect();
            step.frame = Image::new(height, width, pixels).unwrap().rendered_as(&*spec).unwrap();
        }
        let goal_position = if has_goal { vec![0.5; 3] } else { Vec::new() };
        let episode = Episode::new(RecordedEpisode { goal_position, control_hz, ..info(&steps) }, steps).unwrap();
        let bytes = to_bytes(&episode).unwrap();
        prop_assert_eq!(to_bytes(&episode).unwrap(), bytes.clone(), "the same episode, the same bytes");
        prop_assert_eq!(from_bytes(&bytes).unwrap(), episode);
    }

    #[test]
    fn any_bytes_are_refused(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        prop_assert!(from_bytes(&bytes).is_err());
        prop_assert!(from_bytes(&[mcap::MAGIC, &bytes].concat()).is_err());
    }
}

/// Flips every byte in turn, in records, indexes, checksums and the file's magic.
#[test]
fn a_flipped_byte_is_refused_or_changes_nothing() {
    let episode = episode(3, 2);
    let good = to_bytes(&episode).unwrap();
    let mut harmless = 0;
    for offset in 0..good.len() {
        for bits in [0x01, 0xff] {
            let mut bytes = good.clone();
            bytes[offset] ^= bits;
            if let Ok(read) = from_bytes(&bytes) {
                assert_eq!(read, episode, "byte {offset} ^ {bits:#x}");
                harmless += 1;
            }
        }
    }
    assert!(harmless < good.len() / 100, "{harmless} of {} flips were not noticed", 2 * good.len());
}

#[test]
fn a_truncated_file_is_refused() {
    let good = to_bytes(&episode(3, 2)).unwrap();
    for length in 0..good.len() {
        assert!(matches!(from_bytes(&good[..length]), Err(ReadError::Mcap(_) | ReadError::Content(_))), "{length}");
    }
    assert!(from_bytes(&[&good[..], b"x"].concat()).is_err(), "nothing may follow the end");
}

/// Lengths inside a record are not trusted: a file may have no checksums.
#[test]
fn lengths_inside_records_are_not_trusted() {
    let record = |opcode: u8, data: &[u8]| [&[opcode][..], &(data.len() as u64).to_le_bytes(), data].concat();
    let refusal = |records: &[u8]| from_bytes(&[mcap::MAGIC, records].concat()).unwrap_err().to_string();

    let endless = [&[1, 0][..], &u32::MAX.to_le_bytes(), b"name"].concat();
    let error = "recording: record: expected 4294967295 bytes more, got 4";
    assert_eq!(refusal(&record(op::SCHEMA, &endless)), error);

    // A chunk of 9 bytes, with the begin of a message of 100.
    let message = record(op::MESSAGE, &[0; 100]);
    let chunk = [&[0; 32][..], &9u64.to_le_bytes(), &message[..9]].concat();
    let error = "recording: channel: expected a known one, got 0";
    assert_eq!(refusal(&[&record(op::CHUNK, &chunk), &message[9..]].concat()), error);
}

#[test]
fn an_oversized_file_is_refused_unread() {
    let error = from_bytes(&vec![0; recording::MAX_BYTES + 1]).unwrap_err().to_string();
    assert_eq!(error, "recording: size: expected at most 67108864 bytes, got 67108865");
}

#[test]
fn the_header_is_read_without_the_rest() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("reach-5.mcap");
    let episode = episode(40, 84);
    let bytes = to_bytes(&episode).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    assert_eq!(recording::read_header(&path).unwrap(), *episode.info());
    assert!(recording::read(&path).is_err());
    std::fs::write(&path, &bytes).unwrap();
    assert_eq!(recording::read(&path).unwrap(), episode);
}

/// Message of a file to be spoiled.
struct Raw {
    topic: String,
    schema: String,
    header: MessageHeader,
    data: Vec<u8>,
}

/// Refusal of an intact MCAP file with other contents.
fn refusal(spoil: impl FnOnce(&mut Vec<Raw>)) -> String {
    let good = to_bytes(&episode(3, 2)).unwrap();
    let mut messages: Vec<Raw> = MessageStream::new(&good)
        .unwrap()
        .map(|message| {
            let message = message.unwrap();
            let (sequence, log_time, publish_time) = (message.sequence, message.log_time, message.publish_time);
            Raw {
                topic: message.channel.topic.clone(),
                schema: message.channel.schema.as_ref().unwrap().name.clone(),
                header: MessageHeader { channel_id: 0, sequence, log_time, publish_time },
                data: message.data.into_owned(),
            }
        })
        .collect();
    spoil(&mut messages);
    let mut writer: Writer<_> = WriteOptions::new().create(Cursor::new(Vec::new())).unwrap();
    for Raw { topic, schema, header, data } in messages {
        let schema = writer.add_schema(&schema, "protobuf", b"any").unwrap();
        let channel_id = writer.add_channel(schema, &topic, "protobuf", &Default::default()).unwrap();
        writer.write_to_known_channel(&MessageHeader { channel_id, ..header }, &data).unwrap();
    }
    writer.finish().unwrap();
    from_bytes(&writer.into_inner().into_inner()).map(drop).unwrap_err().to_string()
}

fn edit<M: prost::Message + Default>(raw: &mut Raw, edit: impl FnOnce(&mut M)) {
    let mut message = M::decode(&raw.data[..]).unwrap();
    edit(&mut message);
    raw.data = message.encode_to_vec();
}

#[test]
fn intact_files_without_a_valid_episode_are_refused() {
    let refusals = [
        (refusal(|m| m.clear()), "/episode: expected a message, got the end of the file"),
        (refusal(|m| drop(m.remove(0))), "topic: expected /episode, got /camera"),
        (refusal(|m| m.truncate(5)), "/camera: expected a message, got the end of the file"),
        (refusal(|m| m.swap(1, 3)), "/camera: expected number 0 at 0 ns, got number 1 at 12500000 ns"),
        (refusal(|m| m.swap(1, 2)), "topic: expected /camera, got /step"),
        (refusal(|m| m[3].header.log_time = 7), "/camera: expected number 1 at 12500000 ns, got number 1 at 7 ns"),
        (
            refusal(|m| m[1].schema = "sensor_msgs/Image".into()),
            "/camera.schema: expected foxglove.RawImage as protobuf, got sensor_msgs/Image as protobuf",
        ),
        (refusal(|m| m[0].data = vec![0xff; 9]), "/episode.payload: expected cpn.v1.RecordedEpisode"),
        (
            refusal(|m| edit::<proto::RecordedEpisode>(&mut m[0], |header| header.steps = 2)),
            "steps: expected no message after step 1, got /camera",
        ),
        (
            refusal(|m| edit::<proto::RecordedEpisode>(&mut m[0], |header| header.digest = "0".repeat(64))),
            "digest: expected 0000",
        ),
        (refusal(|m| edit::<proto::RecordedStep>(&mut m[4], |step| step.reward = 3.0)), "digest: expected "),
        (refusal(|m| edit::<proto::RecordedStep>(&mut m[4], |step| step.step = 2)), "steps[1].step: expected 1, got 2"),
        (
            refusal(|m| edit::<RawImage>(&mut m[1], |image| image.encoding = "bgr8".into())),
            "/camera[0].encoding: expected rgb8, got bgr8",
        ),
        (
            refusal(|m| edit::<RawImage>(&mut m[1], |image| image.data = vec![0; 5].into())),
            "/camera[0].data: expected 12 bytes, got 5 bytes",
        ),
    ];
    for (message, expected) in refusals {
        assert!(message.starts_with(&format!("recording: {expected}")), "{message:?} instead of {expected:?}");
    }
}

#[test]
fn inconsistent_steps_are_refused_with_the_field() {
    type Spoil = fn(&mut RecordedEpisode, &mut Vec<DemonstrationStep>);
    let cases: [(Spoil, &str); 14] = [
        (|_, s| drop(s.pop()), "steps: expected 3, got 2"),
        (|i, s| (i.steps, *s) = (1, s[..1].to_vec()), "steps: expected at least 2, got 1"),
        (|_, s| s[1].step = 4, "steps[1].step: expected 1, got 4"),
        (|_, s| s[1].episode_id = "x".into(), "steps[1].episode_id: expected reach-5, got x"),
        (|_, s| s[1].frame = Image::new(1, 2, vec![0; 6]).unwrap(), "steps[1].frame: expected 2 x 2, got 1 x 2"),
        (
            |_, s| s[2].frame = s[2].frame.clone().rendered_as("other").unwrap(),
            "steps[2].frame.render_spec: expected spec, got other",
        ),
        (|_, s| s[1].state.clear(), "steps[1].state: expected 2 values, got 0 values"),
        (|_, s| s[1].action = None, "steps[1].action: expected an action, got none"),
        (|_, s| s[2].action = Some(vec![0.0; 3]), "steps[2].action: expected none at the goal frame, got an action"),
        (|_, s| s[1].action = Some(vec![0.0]), "steps[1].action: expected 3 values, got 1 values"),
        (|_, s| s[0].action.as_mut().unwrap()[0] = 1.5, "steps[0].action: expected values in [-1, 1], got 1.5"),
        (
            |_, s| s[2].applied_action = Some(vec![0.0; 3]),
            "steps[2].applied_action: expected none at the goal frame, got an action",
        ),
        (|_, s| s[0].applied_action = Some(vec![0.0]), "steps[0].applied_action: expected 3 values, got 1 values"),
        (
            |_, s| s[0].applied_action = Some(vec![0.0, 0.0, -1.5]),
            "steps[0].applied_action: expected values in [-1, 1], got -1.5",
        ),
    ];
    for (spoil, expected) in cases {
        let mut steps = steps(3, 2, "spec");
        let mut info = info(&steps);
        spoil(&mut info, &mut steps);
        assert_eq!(Episode::new(info, steps).unwrap_err().to_string(), expected);
    }
}

/// View of any MCAP library: topics with schemas, and frames with timestamps.
#[test]
fn any_mcap_library_reads_it() {
    let bytes = to_bytes(&episode(3, 2)).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let mut topics: Vec<_> = summary
        .channels
        .values()
        .map(|channel| (channel.topic.clone(), channel.schema.as_ref().unwrap().name.clone()))
        .collect();
    topics.sort();
    let named =
        [("/camera", "foxglove.RawImage"), ("/episode", "cpn.v1.RecordedEpisode"), ("/step", "cpn.v1.RecordedStep")];
    assert_eq!(topics, named.map(|(topic, schema)| (topic.to_owned(), schema.to_owned())));
    assert_eq!(summary.stats.unwrap().message_count, 7);
    let frame = MessageStream::new(&bytes).unwrap().map(Result::unwrap).filter(|m| m.channel.topic == "/camera").nth(2);
    let frame = frame.unwrap();
    let image = RawImage::decode(&frame.data[..]).unwrap();
    assert_eq!((frame.log_time, image.timestamp.unwrap().total_nanos()), (25_000_000, 25_000_000));
    assert_eq!((image.frame_id.as_str(), image.step), ("camera", 6));
    assert!(matches!(frame.data, Cow::Owned(_)), "compressed");
}
