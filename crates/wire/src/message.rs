//! From bytes to valid native values and back.

use crate::Error;
use prost::Message as _;

/// Most values of an action.
pub(crate) const MAX_ACTION: usize = 64;

/// A native type with a protobuf message; the conversion from the message checks every field.
pub trait Message: TryFrom<Self::Proto, Error = Error> + Into<Self::Proto> {
    /// The generated type.
    type Proto: prost::Message + prost::Name + Default;
    /// Largest encoded size that is decoded.
    const MAX_BYTES: usize = 1 << 20;
}

/// The protobuf bytes of a message.
pub fn encode<M: Message>(message: M) -> Vec<u8> {
    message.into().encode_to_vec()
}

/// A valid message from a stranger's bytes.
///
/// # Errors
/// If there are too many bytes, they are not the message, or a field is wrong.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<M, Error> {
    if bytes.len() > M::MAX_BYTES {
        let got = format!("{} bytes", bytes.len());
        return Err(Error::invalid("payload", format!("at most {} bytes", M::MAX_BYTES), got));
    }
    let proto = M::Proto::decode(bytes)
        .map_err(|e| Error::invalid("payload", <M::Proto as prost::Name>::full_name(), format!("{e}")))?;
    M::try_from(proto)
}

/// The value of a message field that must be there, checked by its own conversion.
pub(crate) fn required<P, N: TryFrom<P, Error = Error>>(field: &str, value: Option<P>) -> Result<N, Error> {
    N::try_from(value.ok_or_else(|| Error::missing(field))?).map_err(|e| e.within(field))
}

/// A name that can stand in a key and in a file name: 1 to 64 of `a-z 0-9 . _ -`, not starting with a dot.
pub(crate) fn name(field: &str, value: String) -> Result<String, Error> {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "._-".contains(c);
    if (1..=64).contains(&value.len()) && value.chars().all(allowed) && !value.starts_with('.') {
        Ok(value)
    } else {
        Err(Error::invalid(field, "1 to 64 of a-z, 0-9, '.', '_', '-'", format!("{value:?}")))
    }
}

/// A SHA-256 digest in lower-case hex.
pub(crate) fn digest(field: &str, value: String) -> Result<String, Error> {
    if value.len() == 64 && value.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b)) {
        Ok(value)
    } else {
        Err(Error::invalid(field, "64 lower-case hexadecimal digits", format!("{value:?}")))
    }
}

/// An action: 1 to 64 values, all finite.
pub(crate) fn action(action: crate::proto::Action) -> Result<Vec<f32>, Error> {
    if !(1..=MAX_ACTION).contains(&action.values.len()) {
        return Err(Error::invalid("values", format!("1 to {MAX_ACTION} numbers"), action.values.len()));
    }
    finite("values", action.values)
}

/// Numbers that are all finite.
pub(crate) fn finite(field: &str, values: Vec<f32>) -> Result<Vec<f32>, Error> {
    match values.iter().find(|value| !value.is_finite()) {
        Some(value) => Err(Error::invalid(field, "finite numbers", value)),
        None => Ok(values),
    }
}

/// A position x, y, z in metres, or none.
pub(crate) fn position(field: &str, values: Vec<f32>) -> Result<Vec<f32>, Error> {
    if [0, 3].contains(&values.len()) {
        finite(field, values)
    } else {
        Err(Error::invalid(field, "0 or 3 values", values.len()))
    }
}
