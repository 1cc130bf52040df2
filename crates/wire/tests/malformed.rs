//! Wrong messages are refused with the field at fault, what was expected and what came.

#![expect(clippy::unwrap_used, reason = "a test")]

use prost::Message as _;
use wire::planner::{LoadModelRequest, PlanRequest};
use wire::sim::StepRequest;
use wire::{Code, Error, decode, proto};

fn black(side: u32) -> proto::Image {
    let format = proto::PixelFormat::Rgb8.into();
    proto::Image { height: side, width: side, format, data: vec![0; (side * side * 3) as usize] }
}

fn plan_request() -> proto::PlanRequest {
    proto::PlanRequest {
        model: "cpn".into(),
        goal: Some(proto::plan_request::Goal::GoalImage(black(84))),
        observation: Some(black(84)),
        ..Default::default()
    }
}

/// Decodes a plan request that `spoil` has made wrong.
fn refusal(spoil: impl FnOnce(&mut proto::PlanRequest)) -> Error {
    let mut request = plan_request();
    spoil(&mut request);
    decode::<PlanRequest>(&request.encode_to_vec()).unwrap_err()
}

#[test]
fn the_unspoiled_request_is_fine() {
    decode::<PlanRequest>(&plan_request().encode_to_vec()).unwrap();
}

#[test]
fn each_wrong_field_is_named() {
    let cases: [(Error, &str, &str, &str); 8] = [
        (refusal(|r| r.model = "../x".into()), "model", "1 to 64 of a-z", "\"../x\""),
        (refusal(|r| r.goal = None), "goal", "a value", "none"),
        (
            refusal(|r| r.goal = Some(proto::plan_request::Goal::GoalId("zz".into()))),
            "goal_id",
            "64 lower-case hexadecimal digits",
            "\"zz\"",
        ),
        (refusal(|r| r.observation = None), "observation", "a value", "none"),
        (
            refusal(|r| r.observation.as_mut().unwrap().format = 0),
            "observation.format",
            "PIXEL_FORMAT_RGB8",
            "PIXEL_FORMAT_UNSPECIFIED",
        ),
        (refusal(|r| r.observation.as_mut().unwrap().format = 77), "observation.format", "PIXEL_FORMAT_RGB8", "77"),
        (refusal(|r| r.observation.as_mut().unwrap().data.truncate(9)), "observation.data", "21168 bytes", "9 bytes"),
        (refusal(|r| r.observation.as_mut().unwrap().width = 0), "observation.width", "1 to 512 pixels", "0"),
    ];
    for (error, field, expected, got) in cases {
        assert_eq!(error.code, Code::InvalidArgument);
        assert_eq!(error.field, field);
        assert!(error.expected.starts_with(expected), "{error}");
        assert_eq!(error.got, got);
    }
}

#[test]
fn a_truncated_message_is_refused() {
    let bytes = plan_request().encode_to_vec();
    let error = decode::<PlanRequest>(&bytes[..bytes.len() - 10]).unwrap_err();
    assert_eq!((error.field.as_str(), error.expected.as_str()), ("payload", "cpn.v1.PlanRequest"));
}

#[test]
fn an_endless_message_is_refused_unread() {
    let error = decode::<PlanRequest>(&vec![0; (1 << 20) + 1]).unwrap_err();
    assert_eq!((error.field.as_str(), error.got.as_str()), ("payload", "1048577 bytes"));
}

#[test]
fn an_action_that_is_not_a_number_is_refused() {
    let request =
        proto::StepRequest { action: Some(proto::Action { values: vec![0.0, f32::NAN] }), ..Default::default() };
    let error = decode::<StepRequest>(&request.encode_to_vec()).unwrap_err();
    assert_eq!((error.field.as_str(), error.got.as_str()), ("action.values", "NaN"));
}

#[test]
fn a_model_file_outside_the_folder_is_refused() {
    let source = Some(proto::load_model_request::Source::File("../../etc/passwd".into()));
    let request = proto::LoadModelRequest { model: "cpn".into(), source };
    assert_eq!(decode::<LoadModelRequest>(&request.encode_to_vec()).unwrap_err().field, "file");
}

#[test]
fn errors_survive_a_grpc_status() {
    let error = Error::new(Code::ResourceExhausted, "queue", "a free place", "64 waiting");
    assert_eq!(Error::from(tonic::Status::from(error.clone())), error);
}
