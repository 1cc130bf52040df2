//! Requests of openpi's clients: no input makes the decoder panic, and errors are short.

#![no_main]

use libfuzzer_sys::fuzz_target;
use rmpv::Value;
use wire::Error;
use wire::planner::ListModelsResponse;

/// Maximum length of an error, in bytes; it quotes the request.
const MAX_ERROR_BYTES: usize = 1200;

fuzz_target!(init: fuzz::seed("openpi", requests(), check), |input: &[u8]| {
    if let Err(error) = check(input) {
        assert!(error.to_string().len() <= MAX_ERROR_BYTES, "{error}");
    }
});

fn check(input: &[u8]) -> Result<(), Error> {
    planner::openpi_request(input, || ListModelsResponse { models: Vec::new() }).map(drop)
}

/// A request for each kind of observation and goal.
fn requests() -> Vec<Vec<u8>> {
    let picture = || array("|u1", &[2, 1, 3], vec![7; 6]);
    let position = || array("<f4", &[3], [0.5_f32, -0.25, 0.125].map(f32::to_le_bytes).concat());
    let goal_id = || Value::from("0".repeat(64));
    let observed = [("observation/image", picture()), ("observation/position", position())];
    let goals = [("goal/image", picture()), ("goal/position", position()), ("goal/id", goal_id())];
    let pairs = observed.iter().flat_map(|observed| goals.iter().map(move |goal| [observed.clone(), goal.clone()]));
    let others = || [("model", "cpn".into()), ("seed", 7.into()), ("steps_left", 70.into()), ("prompt", "".into())];
    pairs.map(|pair| packed(pair.into_iter().chain(others()))).collect()
}

fn packed(fields: impl Iterator<Item = (&'static str, Value)>) -> Vec<u8> {
    let map = Value::Map(fields.map(|(name, value)| (name.into(), value)).collect());
    let mut bytes = Vec::new();
    rmpv::encode::write_value(&mut bytes, &map).expect("a vector takes all bytes");
    bytes
}

fn array(dtype: &str, shape: &[u32], data: Vec<u8>) -> Value {
    let shape: Vec<_> = shape.iter().map(|&side| Value::from(side)).collect();
    let pairs: [(&str, Value); 4] =
        [("__ndarray__", true.into()), ("data", data.into()), ("dtype", dtype.into()), ("shape", shape.into())];
    Value::Map(pairs.map(|(name, value)| (name.as_bytes().into(), value)).into())
}
