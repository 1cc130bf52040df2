//! MCAP files of protobuf messages: a writer into memory, and a reader of untrusted files.

use crate::MAX_BYTES;
use crate::records::{Channels, Message};
use crate::topic::{ENCODING, Topic};
use mcap::records::{MessageHeader, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, WriteOptions};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;
use wire::Error;

/// Chunk size, in bytes: an episode of usual length, since a frame compresses only against earlier ones of its chunk.
const CHUNK_BYTES: u64 = 4 << 20;
/// Largest read, in bytes: the claimed length of a record is not trusted.
const READ_BYTES: usize = 64 << 10;

/// Error of reading a recording.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// Unreadable file.
    #[error("recording: {0}")]
    Io(#[from] std::io::Error),
    /// Truncated or damaged MCAP file.
    #[error("recording: {}", reason(.0))]
    Mcap(#[from] McapError),
    /// Intact MCAP file that is not the expected recording.
    #[error("recording: {0}")]
    Content(#[from] Error),
}

/// The error with its cause, which MCAP's own message leaves out.
fn reason(error: &McapError) -> String {
    match error {
        McapError::Parse(cause) => format!("{error}: {cause}"),
        McapError::Io(cause) => format!("{error}: {cause}"),
        _ => error.to_string(),
    }
}

/// Deterministic MCAP writer: the same messages give the same bytes.
pub(crate) struct Writer {
    writer: mcap::Writer<Cursor<Vec<u8>>>,
    channels: Vec<(Topic, u16)>,
}

impl Writer {
    pub(crate) fn new(topics: &[Topic]) -> Result<Self, McapError> {
        let options = WriteOptions::new()
            .library("cpn")
            .chunk_size(Some(CHUNK_BYTES))
            // One file takes too little time for threads to pay off.
            .compression_threads(0);
        let mut writer = options.create(Cursor::new(Vec::new()))?;
        let channels = topics.iter().map(|&topic| {
            let schema = writer.add_schema(&topic.schema_name(), ENCODING, &topic.schema())?;
            Ok((topic, writer.add_channel(schema, topic.name(), ENCODING, &BTreeMap::new())?))
        });
        let channels = channels.collect::<Result<_, McapError>>()?;
        Ok(Self { writer, channels })
    }

    /// Appends a message; `time` is in nanoseconds since the start of the episode.
    ///
    /// # Panics
    /// If the topic is not one that the writer was created with.
    pub(crate) fn write(
        &mut self,
        topic: Topic,
        sequence: u32,
        time: u64,
        message: &impl prost::Message,
    ) -> Result<(), McapError> {
        let channel = self.channels.iter().find(|(known, _)| *known == topic);
        let channel_id = channel.expect("a topic that the file was begun with").1;
        let header = MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
        self.writer.write_to_known_channel(&header, &message.encode_to_vec())
    }

    /// Ends the current chunk.
    pub(crate) fn end_chunk(&mut self) -> Result<(), McapError> {
        self.writer.flush()
    }

    pub(crate) fn finish(mut self) -> Result<Vec<u8>, McapError> {
        self.writer.finish()?;
        Ok(self.writer.into_inner().into_inner())
    }
}

/// Reads a file of at most [`MAX_BYTES`].
pub(crate) fn bytes(path: &Path) -> Result<Vec<u8>, ReadError> {
    let mut bytes = Vec::new();
    File::open(path)?.take(MAX_BYTES as u64 + 1).read_to_end(&mut bytes)?;
    check_size(bytes.len())?;
    Ok(bytes)
}

/// MCAP reader with checksums verified and sizes bounded.
pub(crate) struct Reader<R> {
    source: R,
    reader: LinearReader,
    channels: Channels,
    /// Size of all records read so far.
    bytes: usize,
    /// Whether the summary section has been reached, which only repeats the data section.
    in_summary: bool,
    /// Message that was looked at, and not read yet.
    peeked: Option<Message>,
}

impl<R: Read> Reader<R> {
    pub(crate) fn new(source: R) -> Self {
        let options = LinearReaderOptions::default()
            .with_check_finishes_after_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_record_length_limit(MAX_BYTES);
        let (reader, channels) = (LinearReader::new_with_options(options), Channels::default());
        Self { source, reader, channels, bytes: 0, in_summary: false, peeked: None }
    }

    fn next(&mut self) -> Result<Option<Message>, ReadError> {
        if self.peeked.is_some() {
            return Ok(self.peeked.take());
        }
        while let Some(event) = self.reader.next_event() {
            match event? {
                LinearReadEvent::ReadRequest(bytes) => {
                    let read = self.source.read(self.reader.insert(bytes.min(READ_BYTES)))?;
                    self.reader.notify_read(read);
                }
                LinearReadEvent::Record { opcode, data } => {
                    self.bytes += data.len();
                    check_size(self.bytes)?;
                    self.in_summary |= opcode == op::DATA_END;
                    if !self.in_summary
                        && let Some(message) = self.channels.read(opcode, data)?
                    {
                        return Ok(Some(message));
                    }
                }
            }
        }
        Ok(None)
    }

    /// Whether the next message is of this topic.
    pub(crate) fn next_is(&mut self, topic: Topic) -> Result<bool, ReadError> {
        self.peeked = self.next()?;
        Ok(self.peeked.as_ref().is_some_and(|message| message.channel.topic == topic.name()))
    }

    /// Reads the next message, which must be of this topic and its schema.
    pub(crate) fn of(&mut self, topic: Topic) -> Result<Message, ReadError> {
        let name = topic.name();
        let message = self.next()?.ok_or_else(|| Error::invalid(name, "a message", "the end of the file"))?;
        let channel = &message.channel;
        check("topic", name, &channel.topic)?;
        check(&format!("{name}.schema"), &format!("{} as {ENCODING}", topic.schema_name()), &channel.schema)?;
        check(&format!("{name}.encoding"), ENCODING, &channel.encoding)?;
        Ok(message)
    }

    /// Reads to the end of the file, whose footer has the last checksums; no message may follow the last step of `field`.
    pub(crate) fn end(&mut self, field: &str, last: u32) -> Result<(), ReadError> {
        match self.next()? {
            None => Ok(()),
            Some(extra) => {
                let expected = format!("no message after step {last}");
                Err(Error::invalid(field, expected, extra.channel.topic.clone()).into())
            }
        }
    }
}

pub(crate) fn check(field: &str, expected: &str, got: &str) -> Result<(), Error> {
    if expected == got { Ok(()) } else { Err(Error::invalid(field, expected, got)) }
}

pub(crate) fn check_size(bytes: usize) -> Result<(), Error> {
    if bytes <= MAX_BYTES { Ok(()) } else { Err(Error::invalid("size", format!("at most {MAX_BYTES} bytes"), bytes)) }
}
