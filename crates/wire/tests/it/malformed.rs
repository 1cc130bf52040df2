//! Refusals of invalid messages name the field at fault, what was expected and what came.

use prost::Message as _;
use wire::checkpoint::CheckpointAnnouncement;
use wire::demonstration::{CommitEpisodeRequest, DemonstrationStep};
use wire::planner::{LoadModelRequest, PlanRequest};
use wire::proto::plan_request::{Goal, Observed};
use wire::sim::{ResetResponse, StepRequest, StepResponse};
use wire::training::{Run, StartRunRequest};
use wire::{Code, Error, decode, proto};

fn black(side: u32) -> proto::Image {
    let format = proto::PixelFormat::Rgb8.into();
    proto::Image { height: side, width: side, format, data: vec![0; (side * side * 3) as usize], ..Default::default() }
}

fn plan_request() -> proto::PlanRequest {
    proto::PlanRequest {
        model: "cpn".into(),
        goal: Some(Goal::GoalImage(black(84))),
        observed: Some(Observed::Observation(black(84))),
        ..Default::default()
    }
}

/// Decodes a plan request that `spoil` has made invalid.
fn refusal(spoil: impl FnOnce(&mut proto::PlanRequest)) -> Error {
    let mut request = plan_request();
    spoil(&mut request);
    decode::<PlanRequest>(&request.encode_to_vec()).unwrap_err()
}

fn image_of(request: &mut proto::PlanRequest) -> &mut proto::Image {
    match &mut request.observed {
        Some(Observed::Observation(image)) => image,
        other => panic!("expected an image, got {other:?}"),
    }
}

#[test]
fn the_valid_request_is_decoded() {
    decode::<PlanRequest>(&plan_request().encode_to_vec()).unwrap();
}

#[test]
fn each_wrong_field_is_named() {
    let search = |solver: proto::Solver, samples, anytime| {
        Some(proto::Search { solver: solver.into(), samples, anytime, ..Default::default() })
    };
    let action = |count| proto::Action { values: vec![0.0; count] };
    let approach = |position| Some(proto::Approach { position, ..Default::default() });
    let cases: [(Error, &str, &str, &str); 24] = [
        (refusal(|r| r.model = "../x".into()), "model", "1 to 64 of a-z", "\"../x\""),
        (refusal(|r| r.goal = None), "goal", "a value", "none"),
        (
            refusal(|r| r.goal = Some(Goal::GoalId("zz".into()))),
            "goal_id",
            "64 lower-case hexadecimal digits",
            "\"zz\"",
        ),
        (
            refusal(|r| r.model_digest = "5F".repeat(32)),
            "model_digest",
            "64 lower-case hexadecimal digits",
            &format!("{:?}", "5F".repeat(32)),
        ),
        (refusal(|r| r.observed = None), "observation", "a value", "none"),
        (refusal(|r| image_of(r).format = 0), "observation.format", "PIXEL_FORMAT_RGB8", "PIXEL_FORMAT_UNSPECIFIED"),
        (refusal(|r| image_of(r).format = 77), "observation.format", "PIXEL_FORMAT_RGB8", "77"),
        (refusal(|r| image_of(r).data.truncate(9)), "observation.data", "21168 bytes", "9 bytes"),
        (refusal(|r| image_of(r).width = 0), "observation.width", "1 to 512 pixels", "0"),
        (
            refusal(|r| image_of(r).render_spec = "x".repeat(1025)),
            "observation.render_spec",
            "at most 1024 bytes",
            "1025 bytes",
        ),
        (
            refusal(|r| r.observed = Some(Observed::Position(proto::Position { y: f32::NAN, ..Default::default() }))),
            "position.y",
            "-1000 to 1000 metres",
            "NaN",
        ),
        (
            refusal(|r| r.goal = Some(Goal::GoalPosition(proto::Position { z: 1e4, ..Default::default() }))),
            "goal_position.z",
            "-1000 to 1000 metres",
            "10000",
        ),
        (refusal(|r| r.search = Some(proto::Search::default())), "search.solver", "GRADIENT, CEM, MPPI or HYBRID", "0"),
        (refusal(|r| r.search = search(proto::Solver::Cem, 4097, false)), "search.samples", "at most 4096", "4097"),
        (refusal(|r| r.search = search(proto::Solver::Gradient, 8, false)), "search.samples", "none for GRADIENT", "8"),
        (refusal(|r| r.search = search(proto::Solver::Mppi, 8, true)), "deadline_ms", "a limit", "0"),
        (refusal(|r| r.warm_start = vec![action(4); 65]), "warm_start", "at most 64 actions", "65"),
        (
            refusal(|r| r.warm_start = vec![action(4), proto::Action { values: vec![0.5, -1e4] }]),
            "warm_start",
            "numbers from -1000 to 1000",
            "-10000",
        ),
        (refusal(|r| r.approach = approach(vec![0.0; 2])), "approach.position", "3 numbers", "2"),
        (
            refusal(|r| r.approach = approach(vec![0.0, f32::NAN, 0.0])),
            "approach.position",
            "numbers from -1000 to 1000",
            "NaN",
        ),
        (
            refusal(|r| (r.approach, r.warm_start) = (approach(vec![0.0; 3]), vec![action(4)])),
            "approach",
            "none together with a warm start",
            "one",
        ),
        (
            refusal(|r| (r.approach, r.search) = (approach(vec![0.0; 3]), search(proto::Solver::Cem, 8, false))),
            "approach",
            "none together with a search",
            "one",
        ),
        (refusal(|r| r.steps_left = Some(0)), "steps_left", "1 to 10000", "0"),
        (refusal(|r| r.steps_left = Some(10_001)), "steps_left", "1 to 10000", "10001"),
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
fn an_oversized_message_is_refused_undecoded() {
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
fn a_position_of_two_values_is_refused() {
    let observation = Some(black(84));
    let response = proto::StepResponse { observation, hand_position: vec![0.0; 2], ..Default::default() };
    let error = decode::<StepResponse>(&response.encode_to_vec()).unwrap_err();
    assert_eq!((error.field.as_str(), error.got.as_str()), ("hand_position", "2"));
}

#[test]
fn progress_and_control_of_no_sense_are_refused() {
    let sound = proto::ResetResponse {
        goal: Some(black(84)),
        observation: Some(black(84)),
        hand_position: vec![0.0; 3],
        goal_hand_position: vec![0.0; 3],
        control: Some(proto::Control { action_size: 4, metres: 0.01, hz: 80.0 }),
        ..Default::default()
    };
    decode::<ResetResponse>(&sound.encode_to_vec()).unwrap();
    type Spoil = fn(&mut proto::ResetResponse);
    let cases: [(Spoil, &str); 6] = [
        (|it| it.progress = f64::NAN, "progress"),
        (|it| it.progress = 1.5, "progress"),
        (|it| it.control = None, "control"),
        (|it| it.control.as_mut().unwrap().action_size = 2, "control.action_size"),
        (|it| it.control.as_mut().unwrap().metres = 0.0, "control.metres"),
        (|it| it.control.as_mut().unwrap().hz = f64::INFINITY, "control.hz"),
    ];
    for (spoil, field) in cases {
        let mut response = sound.clone();
        spoil(&mut response);
        assert_eq!(decode::<ResetResponse>(&response.encode_to_vec()).unwrap_err().field, field);
    }
}

#[test]
fn each_wrong_field_of_a_commit_is_named() {
    let good = || proto::RecordedEpisode {
        episode_id: "reach-1".into(),
        variation: Some(proto::Variation { task: "reach".into(), seed: 1 }),
        steps: 2,
        digest: "0".repeat(64),
        goal_position: Vec::new(),
        control_hz: 10.0,
        render_spec: String::new(),
    };
    let decode = |episode| {
        decode::<CommitEpisodeRequest>(&proto::CommitEpisodeRequest { episode: Some(episode) }.encode_to_vec())
    };
    decode(good()).unwrap();
    type Spoil = fn(&mut proto::RecordedEpisode);
    let cases: [(Spoil, &str, &str); 9] = [
        (|e| e.render_spec = "x".repeat(1025), "episode.render_spec", "1025 bytes"),
        (|e| e.steps = 1, "episode.steps", "1"),
        (|e| e.digest = "ABC".into(), "episode.digest", "\"ABC\""),
        (|e| e.goal_position = vec![0.0; 2], "episode.goal_position", "2"),
        (|e| e.goal_position = vec![0.0, 0.0, f32::INFINITY], "episode.goal_position", "inf"),
        (|e| e.control_hz = 0.0, "episode.control_hz", "0"),
        (|e| e.control_hz = f64::NAN, "episode.control_hz", "NaN"),
        (|e| e.control_hz = 10_001.0, "episode.control_hz", "10001"),
        (|e| e.variation = None, "episode.variation", "none"),
    ];
    for (spoil, field, got) in cases {
        let mut episode = good();
        spoil(&mut episode);
        let error = decode(episode).unwrap_err();
        assert_eq!((error.field.as_str(), error.got.as_str()), (field, got));
    }
}

#[test]
fn each_wrong_field_of_a_step_is_named() {
    let good = || proto::DemonstrationStep {
        episode_id: "reach-1".into(),
        frame: Some(black(84)),
        state: vec![0.0; 39],
        ..Default::default()
    };
    decode::<DemonstrationStep>(&good().encode_to_vec()).unwrap();
    type Spoil = fn(&mut proto::DemonstrationStep);
    let cases: [(Spoil, &str, &str); 6] = [
        (|s| s.step = 1000, "step", "1000"),
        (|s| s.state = vec![0.0; 1025], "state", "1025"),
        (|s| s.state[3] = f32::NAN, "state", "NaN"),
        (|s| s.reward = f32::NEG_INFINITY, "reward", "-inf"),
        (|s| s.action = Some(proto::Action { values: vec![0.0; 65] }), "action.values", "65"),
        (|s| s.applied_action = Some(proto::Action { values: vec![0.0; 65] }), "applied_action.values", "65"),
    ];
    for (spoil, field, got) in cases {
        let mut step = good();
        spoil(&mut step);
        let error = decode::<DemonstrationStep>(&step.encode_to_vec()).unwrap_err();
        assert_eq!((error.field.as_str(), error.got.as_str()), (field, got));
    }
}

#[test]
fn each_wrong_field_of_an_announcement_is_named() {
    let digest = || "0".repeat(64);
    let good = || proto::CheckpointManifest {
        model: "cpn".into(),
        version: 1,
        digest: digest(),
        size_bytes: 1,
        config_digest: digest(),
        parents: vec![digest()],
        signature_bundle: "{}".into(),
    };
    let decode = |manifest| {
        let announcement = proto::CheckpointAnnouncement { manifest, promoted_unix_nanos: 1 };
        decode::<CheckpointAnnouncement>(&announcement.encode_to_vec())
    };
    decode(Some(good())).unwrap();
    assert_eq!(decode(None).unwrap_err().field, "manifest");
    type Spoil = fn(&mut proto::CheckpointManifest);
    let cases: [(Spoil, &str, &str); 7] = [
        (|m| m.model = "../x".into(), "manifest.model", "\"../x\""),
        (|m| m.version = 0, "manifest.version", "0"),
        (|m| m.digest = "zz".into(), "manifest.digest", "\"zz\""),
        (|m| m.config_digest = String::new(), "manifest.config_digest", "\"\""),
        (|m| m.parents = vec!["zz".into()], "manifest.parents", "\"zz\""),
        (|m| m.parents = vec!["0".repeat(64); 65], "manifest.parents", "65"),
        (|m| m.signature_bundle = "x".repeat(65_537), "manifest.signature_bundle", "65537 bytes"),
    ];
    for (spoil, field, got) in cases {
        let mut manifest = good();
        spoil(&mut manifest);
        let error = decode(Some(manifest)).unwrap_err();
        assert_eq!((error.field.as_str(), error.got.as_str()), (field, got));
    }
}

#[test]
fn each_wrong_field_of_a_run_is_named() {
    let good = || proto::Run {
        name: "cpn".into(),
        state: proto::RunState::Finished.into(),
        progress: Some(proto::TrainingProgress { step: 3, steps: 9, ..Default::default() }),
        digest: "0".repeat(64),
        reason: String::new(),
    };
    decode::<Run>(&good().encode_to_vec()).unwrap();
    type Spoil = fn(&mut proto::Run);
    let cases: [(Spoil, &str, &str); 6] = [
        (|r| r.name = "a/b".into(), "name", "\"a/b\""),
        (|r| r.state = 0, "state", "RUN_STATE_UNSPECIFIED"),
        (|r| r.digest = "ABC".into(), "digest", "\"ABC\""),
        (|r| (r.state, r.reason) = (proto::RunState::Failed.into(), "x".repeat(2001)), "reason", "2001 bytes"),
        (|r| r.progress = Some(proto::TrainingProgress::default()), "progress.steps", "0"),
        (
            |r| r.progress = Some(proto::TrainingProgress { steps: 1, loss: f64::NAN, ..Default::default() }),
            "progress.loss",
            "NaN",
        ),
    ];
    for (spoil, field, got) in cases {
        let mut run = good();
        spoil(&mut run);
        let error = decode::<Run>(&run.encode_to_vec()).unwrap_err();
        assert_eq!((error.field.as_str(), error.got.as_str()), (field, got));
    }
}

#[test]
fn each_wrong_field_of_a_start_is_named() {
    let good = || proto::StartRunRequest { name: "cpn".into(), ..Default::default() };
    decode::<StartRunRequest>(&good().encode_to_vec()).unwrap();
    type Spoil = fn(&mut proto::StartRunRequest);
    let cases: [(Spoil, &str, &str); 5] = [
        (|r| r.name = String::new(), "name", "\"\""),
        (|r| r.preset = "A".into(), "preset", "\"A\""),
        (|r| r.hold_out = vec!["reach".into(), "../reach".into()], "hold_out", "\"../reach\""),
        (|r| r.hold_out = vec!["reach".into(); 1001], "hold_out", "1001"),
        (|r| r.settings = "#".repeat((16 << 10) + 1), "settings", "16385 bytes"),
    ];
    for (spoil, field, got) in cases {
        let mut request = good();
        spoil(&mut request);
        let error = decode::<StartRunRequest>(&request.encode_to_vec()).unwrap_err();
        assert_eq!((error.field.as_str(), error.got.as_str()), (field, got));
    }
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
