//! Messages: no bytes make a decoder panic, and what decodes is encoded to bytes that decode to the same again.

#![no_main]

mod examples;

use examples::EXAMPLES;
use libfuzzer_sys::fuzz_target;
use wire::{Error, Message, decode, encode};

/// Longest error, in bytes; it travels in a header of gRPC.
const MAX_ERROR_BYTES: usize = 1200;

fuzz_target!(init: fuzz::seed("messages", inputs(), check), |input: &[u8]| {
    if let Err(error) = check(input) {
        assert!(error.to_string().len() <= MAX_ERROR_BYTES, "{error}");
    }
});

/// Decodes all but the first byte, as the message that this stands for.
fn check(input: &[u8]) -> Result<(), Error> {
    let Some((&number, bytes)) = input.split_first() else { return Ok(()) };
    let (survives, _) = &EXAMPLES[usize::from(number) % EXAMPLES.len()];
    survives(bytes)
}

fn inputs() -> Vec<Vec<u8>> {
    (0..).zip(EXAMPLES.iter()).map(|(number, (_, bytes))| [&[number][..], bytes].concat()).collect()
}

/// Compares bytes, since some messages may hold what is not a number.
fn survives<M: Message>(bytes: &[u8]) -> Result<(), Error> {
    let copy = encode(decode::<M>(bytes)?);
    let same = decode::<M>(&copy).expect("what was encoded can be decoded");
    assert_eq!(encode(same), copy);
    Ok(())
}
