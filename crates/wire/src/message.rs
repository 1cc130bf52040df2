//! Encoding and validating decoding of messages.

use crate::Error;
use prost::Message as _;

/// Maximum length of an action.
pub(crate) const MAX_ACTION: usize = 64;

/// Native type of a protobuf message; the conversion from the message validates every field.
pub trait Message: TryFrom<Self::Proto, Error = Error> + Into<Self::Proto> {
    /// Generated protobuf type.
    type Proto: prost::Message + prost::Name + Default;
    /// Largest encoded size that [`decode`] accepts, in bytes.
    const MAX_BYTES: usize = 1 << 20;
}

/// Encodes a message as protobuf.
pub fn encode<M: Message>(message: M) -> Vec<u8> {
    message.into().encode_to_vec()
}

/// Decodes and validates untrusted protobuf bytes.
///
/// # Errors
/// If there are more than [`Message::MAX_BYTES`], they are not the message, or a field is invalid.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<M, Error> {
    if bytes.len() > M::MAX_BYTES {
        let got = format!("{} bytes", bytes.len());
        return Err(Error::invalid("payload", format!("at most {} bytes", M::MAX_BYTES), got));
    }
    let proto = M::Proto::decode(bytes)
        .map_err(|e| Error::invalid("payload", <M::Proto as prost::Name>::full_name(), format!("{e}")))?;
    M::try_from(proto)
}

/// Value of a required message field, validated by its own conversion.
pub(crate) fn required<P, N: TryFrom<P, Error = Error>>(field: &str, value: Option<P>) -> Result<N, Error> {
    N::try_from(value.ok_or_else(|| Error::missing(field))?).map_err(|e| e.within(field))
}

/// Validates a name, which must be usable in a key and as a file name: 1 to 64 of `a-z 0-9 . _ -`, not starting with a dot.
pub(crate) fn name(field: &str, value: String) -> Result<String, Error> {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "._-".contains(c);
    if (1..=64).contains(&value.len()) && value.chars().all(allowed) && !value.starts_with('.') {
        Ok(value)
    } else {
        Err(Error::invalid(field, "1 to 64 of a-z, 0-9, '.', '_', '-'", format!("{value:?}")))
    }
}

/// Validates a SHA-256 digest in lower-case hex.
pub(crate) fn digest(field: &str, value: String) -> Result<String, Error> {
    if value.len() == 64 && value.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b)) {
        Ok(value)
    } else {
        Err(Error::invalid(field, "64 lower-case hexadecimal digits", format!("{value:?}")))
    }
}

/// Validates an action: 1 to 64 values, all finite.
pub(crate) fn action(action: crate::proto::Action) -> Result<Vec<f32>, Error> {
    if !(1..=MAX_ACTION).contains(&action.values.len()) {
        return Err(Error::invalid("values", format!("1 to {MAX_ACTION} numbers"), action.values.len()));
    }
    finite("values", action.values)
}

/// Validates that all values are finite.
pub(crate) fn finite(field: &str, values: Vec<f32>) -> Result<Vec<f32>, Error> {
    match values.iter().find(|value| !value.is_finite()) {
        Some(value) => Err(Error::invalid(field, "finite numbers", value)),
        None => Ok(values),
    }
}

/// Validates a position x, y, z in metres, or no values for none.
pub(crate) fn position(field: &str, values: Vec<f32>) -> Result<Vec<f32>, Error> {
    if [0, 3].contains(&values.len()) {
        finite(field, values)
    } else {
        Err(Error::invalid(field, "0 or 3 values", values.len()))
    }
}
