//! Requests of the Open Inference Protocol: no input makes the decoder panic, and errors are short.

#![no_main]

use libfuzzer_sys::fuzz_target;
use prost::Message as _;
use wire::Error;
use wire::inference::infer_parameter::ParameterChoice;
use wire::inference::model_infer_request::{InferInputTensor, InferRequestedOutputTensor};
use wire::inference::{InferParameter, InferTensorContents, ModelInferRequest};

/// Maximum length of an error, in bytes; it quotes the request.
const MAX_ERROR_BYTES: usize = 1200;

fuzz_target!(init: fuzz::seed("kserve", requests(), check), |input: &[u8]| {
    if let Err(error) = check(input) {
        assert!(error.to_string().len() <= MAX_ERROR_BYTES, "{error}");
    }
});

fn check(input: &[u8]) -> Result<(), Error> {
    let request = ModelInferRequest::decode(input).map_err(|e| Error::invalid("payload", "a protobuf message", e))?;
    planner::kserve_request(request).map(drop)
}

/// Requests between images and between positions, with raw and with typed contents.
fn requests() -> Vec<Vec<u8>> {
    let images = || ["observation", "goal"].map(|name| tensor(name, "UINT8", &[84, 84, 3])).to_vec();
    let positions = || ["observation", "goal"].map(|name| tensor(name, "FP32", &[3])).to_vec();
    let metres = [0.5_f32, -0.25, 0.125];
    let mut typed: Vec<_> = positions();
    for input in &mut typed {
        input.contents = Some(Box::new(InferTensorContents { fp32_contents: metres.to_vec(), ..Default::default() }));
    }
    typed.push(InferInputTensor {
        contents: Some(Box::new(InferTensorContents { int_contents: vec![70], ..Default::default() })),
        ..tensor("steps_left", "INT32", &[1])
    });
    let raw_position = metres.map(f32::to_le_bytes).concat();
    [
        request(images(), vec![vec![7; 84 * 84 * 3]; 2]),
        request(positions(), vec![raw_position; 2]),
        request(typed, Vec::new()),
    ]
    .map(|request| request.encode_to_vec())
    .into()
}

fn request(inputs: Vec<InferInputTensor>, raw_input_contents: Vec<Vec<u8>>) -> ModelInferRequest {
    let number = |name: &str, number| {
        let parameter_choice = Some(ParameterChoice::Int64Param(number));
        (name.to_owned(), InferParameter { parameter_choice })
    };
    ModelInferRequest {
        model_name: "cpn".into(),
        model_version: "0".repeat(64),
        id: "7".into(),
        parameters: [number("seed", 7), number("updates", 2), number("timeout", 50_000)].into(),
        inputs,
        outputs: vec![InferRequestedOutputTensor { name: "plan".into(), ..Default::default() }],
        raw_input_contents,
    }
}

fn tensor(name: &str, datatype: &str, shape: &[i64]) -> InferInputTensor {
    InferInputTensor { name: name.into(), datatype: datatype.into(), shape: shape.into(), contents: None }
}
