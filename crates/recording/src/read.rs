//! An episode from the bytes of a file, which a stranger may have written.

use crate::schema::{ENCODING, PIXELS, Topic, log_time_nanos};
use crate::{Episode, MAX_BYTES};
use foxglove::messages::RawImage;
use mcap::io::MessageReader;
use mcap::sans_io::LinearReaderOptions;
use mcap::{McapError, Message};
use prost::Message as _;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use wire::demonstration::{RecordedEpisode, RecordedStep};
use wire::{Error, Image, decode};

/// Why a recording was refused.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The file could not be read.
    #[error("recording: {0}")]
    Io(#[from] std::io::Error),
    /// Not a whole and undamaged MCAP file.
    #[error("recording: {}", reason(.0))]
    Mcap(#[from] McapError),
    /// Undamaged, but not the recording of an episode.
    #[error("recording: {0}")]
    Content(#[from] Error),
}

/// The error with what caused it, which MCAP's own message leaves out.
fn reason(error: &McapError) -> String {
    match error {
        McapError::Parse(cause) => format!("{error}: {cause}"),
        McapError::Io(cause) => format!("{error}: {cause}"),
        _ => error.to_string(),
    }
}

/// Reads a recording.
///
/// # Errors
/// If it is too large, truncated, damaged (every part has a checksum), or does not hold one episode: a header, then each
/// step's frame and the step, in order, that together have the header's digest.
pub fn from_bytes(bytes: &[u8]) -> Result<Episode, ReadError> {
    if bytes.len() > MAX_BYTES {
        return Err(too_large(bytes.len()).into());
    }
    let mut messages = Messages::new(bytes);
    let info = messages.header()?;
    let mut steps = Vec::new();
    for number in 0..info.steps {
        let time = log_time_nanos(number, info.control_hz);
        let frame = frame(&messages.of_step(Topic::Camera, number, time)?)
            .and_then(|frame| frame.rendered_as(&info.render_spec))
            .map_err(|e| e.within(&format!("/camera[{number}]")))?;
        let step: RecordedStep = decode(&messages.of_step(Topic::Step, number, time)?)
            .map_err(|e: Error| e.within(&format!("/step[{number}]")))?;
        steps.push(step.with_frame(info.episode_id.clone(), frame));
    }
    // To the end of the file: its last checksums are there.
    if let Some(extra) = messages.next()? {
        let expected = format!("no message after step {}", info.steps - 1);
        return Err(Error::invalid("steps", expected, extra.channel.topic.clone()).into());
    }
    Ok(Episode::new(info, steps)?)
}

/// Reads a recording's file.
///
/// # Errors
/// As [`from_bytes`], or if the file cannot be read.
pub fn read(path: &Path) -> Result<Episode, ReadError> {
    let mut bytes = Vec::new();
    File::open(path)?.take(MAX_BYTES as u64 + 1).read_to_end(&mut bytes)?;
    from_bytes(&bytes)
}

/// Reads the header alone, which comes first; whatever follows is not looked at.
///
/// # Errors
/// If the file cannot be read, or does not begin with an undamaged header.
pub fn read_header(path: &Path) -> Result<RecordedEpisode, ReadError> {
    Messages::new(BufReader::new(File::open(path)?)).header()
}

/// The messages of a file, checked and bounded.
struct Messages<R> {
    reader: MessageReader<R>,
    bytes: usize,
}

impl<R: Read> Messages<R> {
    fn new(source: R) -> Self {
        let options = LinearReaderOptions::default()
            .with_check_finishes_after_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_record_length_limit(MAX_BYTES);
        Self { reader: MessageReader::new_with_options(source, options), bytes: 0 }
    }

    fn next(&mut self) -> Result<Option<Message<'static>>, ReadError> {
        let Some(message) = self.reader.next().transpose()? else { return Ok(None) };
        self.bytes += message.data.len();
        if self.bytes > MAX_BYTES {
            return Err(too_large(self.bytes).into());
        }
        Ok(Some(message))
    }

    /// The next message, which must be of this topic and its schema.
    fn of(&mut self, topic: Topic) -> Result<Message<'static>, ReadError> {
        let name = topic.name();
        let message = self.next()?.ok_or_else(|| Error::invalid(name, "a message", "the end of the file"))?;
        let (channel, schema) = (&message.channel, message.channel.schema.as_ref());
        check("topic", name, &channel.topic)?;
        let expected = format!("{} as {ENCODING}", topic.schema_name());
        let got = schema.map_or("none".to_owned(), |schema| format!("{} as {}", schema.name, schema.encoding));
        check(&format!("{name}.schema"), &expected, &got)?;
        check(&format!("{name}.encoding"), ENCODING, &channel.message_encoding)?;
        Ok(message)
    }

    fn header(&mut self) -> Result<RecordedEpisode, ReadError> {
        let message = self.of(Topic::Episode)?;
        Ok(decode(&message.data).map_err(|e: Error| e.within(Topic::Episode.name()))?)
    }

    fn of_step(&mut self, topic: Topic, number: u32, time: u64) -> Result<Vec<u8>, ReadError> {
        let message = self.of(topic)?;
        let place = |number, nanos| format!("number {number} at {nanos} ns");
        check(topic.name(), &place(number, time), &place(message.sequence, message.log_time))?;
        Ok(message.data.into_owned())
    }
}

fn check(field: &str, expected: &str, got: &str) -> Result<(), Error> {
    if expected == got { Ok(()) } else { Err(Error::invalid(field, expected, got)) }
}

fn too_large(got: usize) -> Error {
    Error::invalid("size", format!("at most {MAX_BYTES} bytes"), got)
}

fn frame(bytes: &[u8]) -> Result<Image, Error> {
    let image = RawImage::decode(bytes).map_err(|e| Error::invalid("payload", "foxglove.RawImage", e))?;
    check("encoding", PIXELS, &image.encoding)?;
    check("step", &image.width.saturating_mul(3).to_string(), &image.step.to_string())?;
    Image::new(image.height, image.width, image.data.into())
}
