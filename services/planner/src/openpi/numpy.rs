//! Numpy arrays in msgpack, in the encoding of openpi's client.

use rmpv::Value;
use std::collections::BTreeMap;
use std::fmt;
use wire::Error;

/// Maximum nesting depth, as `rmpv` counts: a map is two levels, and a request has a list in a map in a map. The library's
/// default would overflow a thread's stack.
const MAX_DEPTH: usize = 16;

/// Fields of a message, by name.
pub(super) type Fields = BTreeMap<String, Value>;

/// Numpy array.
pub(super) struct Array {
    /// Numpy's dtype string: byte order, kind, bytes per element.
    pub(super) dtype: String,
    pub(super) shape: Vec<u32>,
    /// Elements in C order.
    pub(super) data: Vec<u8>,
}

impl fmt::Display for Array {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { dtype, shape, data } = self;
        write!(f, "dtype {dtype}, shape {shape:?}, {} bytes", data.len())
    }
}

impl TryFrom<Value> for Array {
    type Error = Error;

    /// Decodes an array; the caller checks that the data fits the shape.
    fn try_from(value: Value) -> Result<Self, Error> {
        let no_array = |got: &dyn fmt::Display| Error::invalid("", "a numpy array", got);
        let Value::Map(pairs) = value else { return Err(no_array(&brief(&value))) };
        let (mut dtype, mut shape, mut data) = (None, None, None);
        for (key, value) in pairs {
            match (key.as_slice(), value) {
                (Some(b"dtype"), value) => dtype = value.as_str().map(str::to_owned),
                (Some(b"shape"), Value::Array(sides)) => shape = sides.iter().map(side).collect(),
                (Some(b"data"), Value::Binary(bytes)) => data = Some(bytes),
                _ => (),
            }
        }
        match (dtype, shape, data) {
            (Some(dtype), Some(shape), Some(data)) => Ok(Self { dtype, shape, data }),
            _ => Err(no_array(&"a map without dtype, shape and data of one")),
        }
    }
}

/// Unpacks a numpy scalar or a zero-dimensional array, which are encoded as maps, to a number or text. Other values are returned
/// unchanged.
pub(super) fn scalar(value: Value) -> Value {
    let Value::Map(pairs) = &value else { return value };
    let of_name = |name: &[u8]| pairs.iter().find(|(key, _)| key.as_slice() == Some(name)).map(|(_, value)| value);
    let is = |name: &[u8]| of_name(name).and_then(Value::as_bool) == Some(true);
    let packed = match of_name(b"data") {
        Some(data) if is(b"__npgeneric__") => Some(data.clone()),
        Some(Value::Binary(data)) if is(b"__ndarray__") && of_name(b"shape") == Some(&Value::Array(Vec::new())) => {
            of_name(b"dtype").and_then(Value::as_str).and_then(|dtype| element(dtype, data))
        }
        _ => None,
    };
    packed.unwrap_or(value)
}

/// Element of a zero-dimensional array: an integer, bytes, or UTF-32 text.
fn element(dtype: &str, data: &[u8]) -> Option<Value> {
    let wide = |fill: u8| {
        let mut bytes = [fill; 8];
        bytes.get_mut(..data.len())?.copy_from_slice(data);
        Some(bytes)
    };
    let sign = if data.last().is_some_and(|byte| *byte >= 0x80) { 0xff } else { 0 };
    match dtype.as_bytes() {
        [b'<' | b'|', b'u', ..] => Some(u64::from_le_bytes(wide(0)?).into()),
        [b'<' | b'|', b'i', ..] => Some(i64::from_le_bytes(wide(sign)?).into()),
        [b'|', b'S', ..] => {
            let end = data.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
            Some(Value::Binary(data[..end].to_vec()))
        }
        [b'<', b'U', ..] => {
            let (letters, []) = data.as_chunks() else { return None };
            let letters = letters.iter().map(|letter| char::from_u32(u32::from_le_bytes(*letter)));
            let text: String = letters.collect::<Option<_>>()?;
            Some(text.trim_end_matches('\0').into())
        }
        _ => None,
    }
}

/// Short description of a value for an error: of containers and bytes only the length.
pub(super) fn brief(value: &Value) -> String {
    match value {
        Value::Map(pairs) => format!("a map of {}", pairs.len()),
        Value::Array(values) => format!("a list of {}", values.len()),
        Value::Binary(bytes) => format!("{} bytes", bytes.len()),
        _ => value.to_string(),
    }
}

fn side(value: &Value) -> Option<u32> {
    value.as_u64()?.try_into().ok()
}

/// Encodes a float32 array `[rows, columns]`; all rows have the same length.
pub(super) fn matrix(rows: &[Vec<f32>]) -> Value {
    let shape = [rows.len(), rows.first().map_or(0, Vec::len)];
    let data: Vec<u8> = rows.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
    let pairs: [(&[u8], Value); 4] = [
        (b"__ndarray__", true.into()),
        (b"data", data.into()),
        (b"dtype", "<f4".into()),
        (b"shape", shape.map(Value::from).to_vec().into()),
    ];
    Value::Map(pairs.map(|(key, value)| (key.into(), value)).into())
}

/// Map with string keys.
pub(super) fn map<K: Into<Value>>(fields: impl IntoIterator<Item = (K, Value)>) -> Value {
    Value::Map(fields.into_iter().map(|(name, value)| (name.into(), value)).collect())
}

/// Encodes a value.
pub(super) fn write(value: &Value) -> Vec<u8> {
    let mut bytes = Vec::new();
    rmpv::encode::write_value(&mut bytes, value).expect("a vector takes all bytes");
    bytes
}

/// Decodes the fields of a message.
///
/// # Errors
/// If the bytes are not a single map with string keys.
pub(super) fn read(mut bytes: &[u8]) -> Result<Fields, Error> {
    let no_map = |got: &dyn fmt::Display| Error::invalid("payload", "one msgpack map with text for keys", got);
    let value = rmpv::decode::read_value_with_max_depth(&mut bytes, MAX_DEPTH).map_err(|e| no_map(&e))?;
    if !bytes.is_empty() {
        return Err(no_map(&format!("{} bytes more", bytes.len())));
    }
    let Value::Map(pairs) = value else { return Err(no_map(&brief(&value))) };
    let named = |(key, value): (Value, Value)| match key.as_str() {
        Some(name) => Ok((name.to_owned(), value)),
        None => Err(no_map(&format!("the key {}", brief(&key)))),
    };
    pairs.into_iter().map(named).collect()
}
