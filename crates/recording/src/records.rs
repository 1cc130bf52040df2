//! Parser of MCAP's schema, channel and message records.
//!
//! Hand-written, since the library's parser allocates the length that a string claims: 4 GiB for a file of a few bytes.

use mcap::records::op;
use std::collections::BTreeMap;
use std::rc::Rc;
use wire::Error;

/// Channel: topic, schema and encoding of its messages.
pub(crate) struct Channel {
    pub(crate) topic: String,
    /// Name and encoding of the messages' schema.
    pub(crate) schema: Rc<str>,
    pub(crate) encoding: String,
}

/// Message with its channel; `log_time` is in nanoseconds since the start of the episode.
pub(crate) struct Message {
    pub(crate) channel: Rc<Channel>,
    pub(crate) sequence: u32,
    pub(crate) log_time: u64,
    pub(crate) data: Vec<u8>,
}

/// Channels and schemas read so far, by id.
#[derive(Default)]
pub(crate) struct Channels {
    schemas: BTreeMap<u16, Rc<str>>,
    channels: BTreeMap<u16, Rc<Channel>>,
}

impl Channels {
    /// Registers a schema or channel record; returns the message of a message record.
    pub(crate) fn read(&mut self, opcode: u8, record: &[u8]) -> Result<Option<Message>, Error> {
        let mut fields = Fields(record);

        match opcode {
            op::SCHEMA => {
                let (id, name, encoding) = (fields.u16()?, fields.text()?, fields.text()?);
                self.schemas.insert(id, format!("{name} as {encoding}").into());
            }
            op::CHANNEL => {
                let (id, schema) = (fields.u16()?, fields.u16()?);
                let schema = self.schemas.get(&schema).map_or_else(|| "none".into(), Rc::clone);
                let (topic, encoding) = (fields.text()?.to_owned(), fields.text()?.to_owned());
                self.channels.insert(id, Rc::new(Channel { topic, schema, encoding }));
            }
            op::MESSAGE => {
                let id = fields.u16()?;
                let channel = self.channels.get(&id).ok_or_else(|| Error::invalid("channel", "a known one", id))?;
                let (sequence, log_time, _published) = (fields.u32()?, fields.u64()?, fields.u64()?);
                let (channel, data) = (Rc::clone(channel), fields.0.to_vec());
                return Ok(Some(Message { channel, sequence, log_time, data }));
            }
            _ => (),
        }
        Ok(None)
    }
}

/// Unread rest of a record: little-endian integers, and strings prefixed by their lengths.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn u16(&mut self) -> Result<u16, Error> {
        self.bytes().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Result<u32, Error> {
        self.bytes().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, Error> {
        self.bytes().map(u64::from_le_bytes)
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], Error> {
        let (bytes, rest) = self.0.split_first_chunk().ok_or_else(|| self.too_short(N))?;
        self.0 = rest;
        Ok(*bytes)
    }

    fn text(&mut self) -> Result<&'a str, Error> {
        let length = self.u32()? as usize;
        let (text, rest) = self.0.split_at_checked(length).ok_or_else(|| self.too_short(length))?;
        self.0 = rest;
        str::from_utf8(text).map_err(|e| Error::invalid("record", "text", e))
    }

    fn too_short(&self, length: usize) -> Error {
        Error::invalid("record", format!("{length} bytes more"), self.0.len())
    }
}
