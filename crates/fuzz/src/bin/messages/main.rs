//! Messages: no input makes a decoder panic, and decoded messages round-trip.

#![no_main]

mod examples;

use examples::EXAMPLES;
use libfuzzer_sys::fuzz_target;
use wire::{Error, Message, decode, encode};

/// Maximum length of an error, in bytes; it is sent in a gRPC header.
const MAX_ERROR_BYTES: usize = 1200;

fuzz_target!(init: fuzz::seed("messages", inputs(), check), |input: &[u8]| {
    if let Err(error) = check(input) {
        assert!(error.to_string().len() <= MAX_ERROR_BYTES, "{error}");
    }
});

/// Checks an input: the first byte selects the message type of the rest.
fn check(input: &[u8]) -> Result<(), Error> {
    let Some((&number, bytes)) = input.split_first() else { return Ok(()) };
    let (round_trip, _) = &EXAMPLES[usize::from(number) % EXAMPLES.len()];
    round_trip(bytes)
}

fn inputs() -> Vec<Vec<u8>> {
    (0..).zip(EXAMPLES.iter()).map(|(number, (_, bytes))| [&[number][..], bytes].concat()).collect()
}

/// Checks a round trip. Bytes are compared, since messages may contain NaN.
fn round_trip<M: Message>(bytes: &[u8]) -> Result<(), Error> {
    let copy = encode(decode::<M>(bytes)?);
    let same = decode::<M>(&copy).expect("what was encoded can be decoded");
    assert_eq!(encode(same), copy);
    Ok(())
}
