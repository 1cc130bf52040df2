//! TensorBoard event files: scalars as TensorFlow's `Event` messages, framed as TFRecords.
//!
//! Only the fields of scalars are declared, with the numbers of `event.proto` and `summary.proto`.

use crc::{CRC_32_ISCSI, Crc};
use prost::Message;
use std::io::{Result, Write};

/// Checksum of TFRecords, before masking.
const CRC32C: Crc<u32> = Crc::<u32>::new(&CRC_32_ISCSI);

/// Entry of an event file.
#[derive(Clone, PartialEq, Message)]
pub struct Event {
    /// Time of the event, in seconds since the epoch.
    #[prost(double, tag = "1")]
    pub wall_time: f64,
    /// Training step.
    #[prost(int64, tag = "2")]
    pub step: i64,
    /// Content.
    #[prost(oneof = "Content", tags = "3, 5, 7")]
    pub content: Option<Content>,
}

/// Content of an event.
#[derive(Clone, PartialEq, prost::Oneof)]
pub enum Content {
    /// Format of the file, in its first event.
    #[prost(string, tag = "3")]
    FileVersion(String),
    /// Scalars.
    #[prost(message, tag = "5")]
    Summary(Summary),
    /// Start of a session, at which TensorBoard drops older events.
    #[prost(message, tag = "7")]
    SessionLog(SessionLog),
}

/// Scalars of a step.
#[derive(Clone, PartialEq, Message)]
pub struct Summary {
    /// Scalars by tag.
    #[prost(message, repeated, tag = "1")]
    pub values: Vec<Scalar>,
}

/// Scalar of a step.
#[derive(Clone, PartialEq, Message)]
pub struct Scalar {
    /// Name of the series.
    #[prost(string, tag = "1")]
    pub tag: String,
    /// Value; optional, so that zero is encoded.
    #[prost(float, optional, tag = "2")]
    pub value: Option<f32>,
}

/// Change of a session.
#[derive(Clone, Copy, PartialEq, Eq, Message)]
pub struct SessionLog {
    /// 1 for its start.
    #[prost(int32, tag = "1")]
    pub status: i32,
}

/// Writer of one event file.
#[derive(Debug)]
pub(crate) struct EventWriter<W> {
    file: W,
}

impl<W: Write> EventWriter<W> {
    /// Begins a file that replaces older ones of the same run.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub(crate) fn new(file: W, unix_seconds: f64) -> Result<Self> {
        let mut writer = Self { file };
        for content in [Content::FileVersion("brain.Event:2".into()), Content::SessionLog(SessionLog { status: 1 })] {
            writer.write(&Event { wall_time: unix_seconds, step: 0, content: Some(content) })?;
        }
        Ok(writer)
    }

    /// Adds the scalars of a step.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub(crate) fn write_scalars(&mut self, step: i64, unix_seconds: f64, scalars: &[(&str, f32)]) -> Result<()> {
        let values = scalars.iter().map(|&(tag, value)| Scalar { tag: tag.into(), value: Some(value) });
        let content = Content::Summary(Summary { values: values.collect() });
        self.write(&Event { wall_time: unix_seconds, step, content: Some(content) })
    }

    fn write(&mut self, event: &Event) -> Result<()> {
        self.file.write_all(&frame(&event.encode_to_vec()))
    }
}

/// A TFRecord: length, checksum of the length, data, checksum of the data, in little endian.
fn frame(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let [of_length, of_data] = [&length[..], data].map(|bytes| masked_crc(bytes).to_le_bytes());
    [&length, &of_length[..], data, &of_data].concat()
}

fn masked_crc(bytes: &[u8]) -> u32 {
    CRC32C.checksum(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// Events of a file, up to the first truncated or damaged record.
pub fn read(mut bytes: &[u8]) -> Vec<Event> {
    let mut events = Vec::new();
    while let Some((event, rest)) = next(bytes) {
        events.push(event);
        bytes = rest;
    }
    events
}

fn next(bytes: &[u8]) -> Option<(Event, &[u8])> {
    let (length, _) = bytes.split_first_chunk::<8>()?;
    let data = bytes.get(12..)?.get(..usize::try_from(u64::from_le_bytes(*length)).ok()?)?;
    let framed = frame(data);
    let rest = bytes.strip_prefix(&framed[..])?;
    Some((Event::decode(data).ok()?, rest))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The expected bytes come from TensorBoard 2.21.
    #[test]
    fn messages_and_checksums_are_those_of_tensorboard() {
        let encoded =
            |step, wall_time, content| hex::encode(Event { wall_time, step, content: Some(content) }.encode_to_vec());
        let version = Content::FileVersion("brain.Event:2".into());
        assert_eq!(encoded(0, 1.0, version), "09000000000000f03f1a0d627261696e2e4576656e743a32");
        let values = vec![Scalar { tag: "train/loss".into(), value: Some(0.0) }];
        let scalars = "09000000000000004010072a130a110a0a747261696e2f6c6f73731500000000";
        assert_eq!(encoded(7, 2.0, Content::Summary(Summary { values })), scalars);
        let start = Content::SessionLog(SessionLog { status: 1 });
        assert_eq!(encoded(0, 2.0, start), "0900000000000000403a020801");
        assert_eq!(masked_crc(b"123456789"), 0xc78a_b0e5);
    }

    #[test]
    fn a_truncated_file_is_read_up_to_the_last_record() -> Result<()> {
        let mut file = Vec::new();
        EventWriter::new(&mut file, 1.0)?.write_scalars(7, 2.0, &[("train/loss", 0.0), ("train/rate", 0.5)])?;
        let events = read(&file);
        assert_eq!(events.len(), 3);
        let Some(Content::Summary(summary)) = &events[2].content else { panic!("{events:?}") };
        let scalars: Vec<_> = summary.values.iter().map(|scalar| (scalar.tag.as_str(), scalar.value)).collect();
        assert_eq!(scalars, [("train/loss", Some(0.0)), ("train/rate", Some(0.5))]);
        assert_eq!(read(&file[..file.len() - 1]), events[..2]);
        Ok(())
    }
}
