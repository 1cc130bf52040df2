//! Decoding of episodes from untrusted files.

use crate::Episode;
use crate::camera::frame;
use crate::file::{ReadError, Reader, bytes, check, check_size};
use crate::topic::{Topic, log_time_nanos};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use wire::demonstration::{RecordedEpisode, RecordedStep};
use wire::{Error, decode};

/// Decodes a recording: a header, then each step's frame and the step, in order.
///
/// # Errors
/// If it is too large, truncated, damaged (every part has a checksum), or not one valid episode with the header's digest.
pub fn from_bytes(bytes: &[u8]) -> Result<Episode, ReadError> {
    check_size(bytes.len())?;
    let mut reader = Reader::new(bytes);
    let info = header(&mut reader)?;
    let mut steps = Vec::new();
    for number in 0..info.steps {
        let time = log_time_nanos(number, info.control_hz);
        let frame = frame(&of_step(&mut reader, Topic::Camera, number, time)?, &info.render_spec)
            .map_err(|e| e.within(&format!("/camera[{number}]")))?;
        let step: RecordedStep = decode(&of_step(&mut reader, Topic::Step, number, time)?)
            .map_err(|e: Error| e.within(&format!("/step[{number}]")))?;
        steps.push(step.with_frame(info.episode_id.clone(), frame));
    }

    reader.end("steps", info.steps - 1)?;
    Ok(Episode::new(info, steps)?)
}

/// Reads the file of a recording.
///
/// # Errors
/// As [`from_bytes`], or if the file cannot be read.
pub fn read(path: &Path) -> Result<Episode, ReadError> {
    from_bytes(&bytes(path)?)
}

/// Reads only the header, which comes first; the rest of the file is not checked.
///
/// # Errors
/// If the file cannot be read, or does not begin with an undamaged header.
pub fn read_header(path: &Path) -> Result<RecordedEpisode, ReadError> {
    header(&mut Reader::new(BufReader::new(File::open(path)?)))
}

fn header(reader: &mut Reader<impl Read>) -> Result<RecordedEpisode, ReadError> {
    let message = reader.of(Topic::Episode)?;
    Ok(decode(&message.data).map_err(|e: Error| e.within(Topic::Episode.name()))?)
}

fn of_step(reader: &mut Reader<impl Read>, topic: Topic, number: u32, time: u64) -> Result<Vec<u8>, ReadError> {
    let message = reader.of(topic)?;
    let place = |number, nanos| format!("number {number} at {nanos} ns");
    check(topic.name(), &place(number, time), &place(message.sequence, message.log_time))?;
    Ok(message.data)
}
