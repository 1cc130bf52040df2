//! Checkpoints: no input makes the reader panic or allocate too much, and checkpoints that are read round-trip.

#![no_main]

use cpn::archive::{self, Tensors};
use cpn::checkpoint::{self, CheckpointError, Provenance};
use cpn::config::{ConvConfig, ImageEncoderConfig, PositionEncoderConfig};
use cpn::{EncoderConfig, MethodKind, Model, ModelConfig, Training};
use libfuzzer_sys::fuzz_target;
use serde_json::Value;
use std::sync::LazyLock;

fuzz_target!(init: { fuzz::seed("checkpoint", inputs(), check) }, |input: &[u8]| {
    let _ = check(input);
});

/// Checks an input: after a first byte of 0 a file, else the document for the weights of an example. In a mutated file, a document
/// of another length would shift all offsets.
fn check(input: &[u8]) -> Result<(), CheckpointError> {
    match input {
        [] => Ok(()),
        [0, file @ ..] => check_file(file),
        [number, document @ ..] => {
            let Ok(document) = serde_json::from_slice(document) else { return Ok(()) };
            let (weights, _): (Tensors, Value) =
                archive::from_bytes(&EXAMPLES[usize::from(number - 1) % EXAMPLES.len()])?;
            check_file(&archive::to_bytes::<Value>(&weights, &document)?)
        }
    }
}

fn check_file(file: &[u8]) -> Result<(), CheckpointError> {
    let (tensors, document): (Tensors, Value) = archive::from_bytes(file)?;
    let copy = archive::to_bytes(&tensors, &document).expect("what was read can be written");
    let (same, _): (Tensors, Value) = archive::from_bytes(&copy).expect("what was written can be read");
    assert_eq!(archive::to_bytes(&same, &document).expect("what was read can be written"), copy);

    let read = checkpoint::from_bytes(file)?;
    let copy = checkpoint::to_bytes(&read.model, &read.provenance).expect("what was read can be written");
    let same = checkpoint::from_bytes(&copy).expect("what was written can be read");
    assert_eq!((same.provenance, same.config_digest), (read.provenance, read.config_digest));
    Ok(())
}

/// Small checkpoints with each kind of encoder, and one with position dynamics and familiar goals.
static EXAMPLES: LazyLock<[Vec<u8>; 3]> = LazyLock::new(|| {
    let image = |latent| {
        EncoderConfig::Image(ImageEncoderConfig {
            convolutions: vec![ConvConfig { channels: 1, kernel: 8, stride: 16 }],
            latent,
            layer_norm: true,
        })
    };
    let position = EncoderConfig::Position(PositionEncoderConfig {
        centre_mm: [500, 0, -200],
        scale_mm: 400,
        layers: vec![2],
        latent: 2,
        layer_norm: true,
    });
    [
        example(MethodKind::TeBcHorizon, image(2), false),
        example(MethodKind::Cpn, position, false),
        example(MethodKind::Upn, image(3), true),
    ]
});

fn example(method: MethodKind, encoder: EncoderConfig, position_dynamics: bool) -> Vec<u8> {
    let sizes = ModelConfig { hidden: 2, gate_hidden: 1, actions: 2, ..ModelConfig::paper(method) };
    let familiar_goals = if position_dynamics { 2 } else { 0 };
    let config = ModelConfig { encoder, position_dynamics, familiar_goals, ..sizes };
    let provenance = Provenance {
        training_tasks: vec!["reach".into()],
        data_digest: "0".repeat(64),
        render_spec: r#"{"camera":"corner"}"#.into(),
        seed: 5,
        training: Training::paper(),
    };
    let mut model = Model::new(config, 5);
    if position_dynamics {
        model.set_familiar_goals(&[vec![0.0; 3], vec![1.0; 3]]);
    }
    checkpoint::to_bytes(&model, &provenance).expect("a checkpoint")
}

fn inputs() -> Vec<Vec<u8>> {
    let files = EXAMPLES.iter().map(|file| [&[0], &file[..]].concat());
    let documents = (1..).zip(EXAMPLES.iter()).map(|(number, file)| {
        let (_, document): (Tensors, Value) = archive::from_bytes(file).expect("a checkpoint");
        [&[number], document.to_string().as_bytes()].concat()
    });
    files.chain(documents).collect()
}
