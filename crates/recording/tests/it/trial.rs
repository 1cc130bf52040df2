//! Round trip of a trial's recording, and refusals of other files.

use mcap::MessageStream;
use recording::trial::{Exchange, Frame, Recording, from_bytes, to_bytes};
use std::time::Duration;
use wire::planner::{Approach, Goal, PlanRequest, PlanResponse, StageTimes};
use wire::sim::Variation;
use wire::trial::RecordedTrial;
use wire::{Image, Observation, Position};

/// Actions applied between two plans.
const APPLIED: u32 = 2;

fn picture(shade: u8) -> Image {
    Image::new(2, 2, vec![shade; 12]).unwrap().rendered_as("spec").unwrap()
}

fn time(step: u32) -> Duration {
    Duration::from_millis(100 * u64::from(step))
}

fn frames() -> Vec<Frame> {
    (0..=6).map(|step| Frame { image: picture(step as u8), time: time(step) }).collect()
}

fn exchange(plan: u8) -> Exchange {
    let goal: Observation = picture(255).into();
    let step = APPLIED * u32::from(plan);
    let request = PlanRequest {
        model: "cpn".into(),
        goal: Goal::Id(goal.digest()),
        observation: picture(step as u8).into(),
        seed: plan.into(),
        deadline: Some(Duration::from_secs(1)),
        model_digest: None,
        search: None,
        warm_start: vec![vec![0.5, -0.0]],
        steps_left: Some(70 - step),
        approach: None,
    };
    let response = PlanResponse {
        actions: vec![vec![1.5, -0.0], vec![0.0, f32::MIN_POSITIVE]],
        first_action: vec![1.0, -0.0],
        inner_losses: vec![2.0, f32::from(plan)],
        latent_distance: Some(0.0),
        times: StageTimes { queue_seconds: 0.1, encode_seconds: 0.2, plan_seconds: 0.3 },
        model_digest: "a".repeat(64),
        goal_id: goal.digest(),
        iterations: 1,
        iterations_run: 1,
        warm_start: vec![vec![0.0, 1.0]],
        approach: Some(Approach { tried: 1, position: [-0.0, 0.5, f32::MIN_POSITIVE], plans: step }),
    };
    let asked = time(step) + Duration::from_nanos(3);
    Exchange { step, request, asked, response, answered: asked + Duration::from_nanos(7) }
}

fn header() -> RecordedTrial {
    RecordedTrial {
        variation: Variation { task: "reach".into(), seed: 5 },
        model: "cpn".into(),
        model_digest: "a".repeat(64),
        goal: picture(255),
        goal_position: None,
        steps: 6,
        plans: 3,
    }
}

fn exchanges() -> Vec<Exchange> {
    (0..3).map(exchange).collect()
}

fn recording() -> Recording {
    Recording::new(header(), frames(), exchanges()).unwrap()
}

#[test]
fn trials_round_trip() {
    let recording = recording();
    let read = from_bytes(&to_bytes(&recording).unwrap()).unwrap();
    assert_eq!(read, recording);
    // Equality alone would take -0 for 0.
    let bits = |recording: &Recording| -> Vec<u32> {
        recording.exchanges().iter().flat_map(|e| e.response.actions.concat()).map(f32::to_bits).collect()
    };
    assert_eq!(bits(&read), bits(&recording));
}

/// A control has frames and no plans, and a plan from positions has its own observation beside them.
#[test]
fn trials_of_controls_and_of_positions_round_trip() {
    let control = RecordedTrial { model: "oracle".into(), model_digest: String::new(), plans: 0, ..header() };
    let position = Position::new([0.5, -0.25, 0.125]).unwrap();
    let exchanges = exchanges().into_iter().map(|mut exchange| {
        (exchange.request.goal, exchange.request.observation) = (Goal::Position(position), position.into());
        exchange
    });
    let positions = RecordedTrial { goal_position: Some(position), ..header() };
    for recording in [
        Recording::new(control, frames(), Vec::new()).unwrap(),
        Recording::new(positions, frames(), exchanges.collect()).unwrap(),
    ] {
        assert_eq!(from_bytes(&to_bytes(&recording).unwrap()).unwrap(), recording);
    }
}

#[test]
fn a_truncated_file_is_refused() {
    let good = to_bytes(&recording()).unwrap();
    for length in (0..good.len()).step_by(41) {
        assert!(from_bytes(&good[..length]).is_err(), "{length}");
    }
}

#[test]
fn inconsistent_trials_are_refused_with_the_field() {
    type Spoil = fn(&mut RecordedTrial, &mut Vec<Frame>, &mut Vec<Exchange>);
    let cases: [(Spoil, &str); 9] = [
        (|_, f, _| drop(f.pop()), "frames: expected 7, got 6"),
        (|_, f, _| f[4].image = Image::new(2, 2, vec![4; 12]).unwrap(), "frames[4].render_spec: expected spec, got "),
        (|_, _, e| drop(e.pop()), "plans: expected 3, got 2"),
        (|_, _, e| e[1].request.model = "upn".into(), "plans[1].request.model: expected cpn, got upn"),
        (|_, _, e| e[1].step = 0, "plans[1].step: expected at least 1 and less than 6, got 0"),
        (|_, _, e| e[2].step = 6, "plans[2].step: expected at least 3 and less than 6, got 6"),
        (|_, _, e| e[1].step = 3, "plans[1].request.observation: expected frame 3, got another image"),
        (|t, _, _| t.goal_position = Some(Position::new([0.0; 3]).unwrap()), "plans[0].request.goal: expected "),
        (|_, _, e| e[2].response.model_digest = "b".repeat(64), "plans[2].response.model_digest: expected aaa"),
    ];
    for (spoil, expected) in cases {
        let (mut trial, mut frames, mut exchanges) = (header(), frames(), exchanges());
        spoil(&mut trial, &mut frames, &mut exchanges);
        let error = Recording::new(trial, frames, exchanges).unwrap_err().to_string();
        assert!(error.starts_with(expected), "{error:?} instead of {expected:?}");
    }
}

/// The file of a trial is refused as a demonstration, and the reverse.
#[test]
fn trials_and_demonstrations_are_not_confused() {
    let trial = to_bytes(&recording()).unwrap();
    let error = recording::from_bytes(&trial).unwrap_err().to_string();
    let expected = "cpn.v1.RecordedEpisode as protobuf, got cpn.v1.RecordedTrial as protobuf";
    assert_eq!(error, format!("recording: /episode.schema: expected {expected}"));
}

/// View of any MCAP library: topics with schemas, and messages with log times; each image is there once.
#[test]
fn any_mcap_library_reads_it() {
    let bytes = to_bytes(&recording()).unwrap();
    let messages: Vec<_> = MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
    let told: Vec<_> = messages[..6]
        .iter()
        .map(|m| (m.channel.topic.as_str(), m.channel.schema.as_ref().unwrap().name.as_str(), m.sequence, m.log_time))
        .collect();
    let expected = [
        ("/episode", "cpn.v1.RecordedTrial", 0, 0),
        ("/camera", "foxglove.RawImage", 0, 0),
        ("/plan/request", "cpn.v1.PlanRequest", 0, 3),
        ("/plan/response", "cpn.v1.PlanResponse", 0, 10),
        ("/camera", "foxglove.RawImage", 1, 100_000_000),
        ("/camera", "foxglove.RawImage", 2, 200_000_000),
    ];
    assert_eq!((told, messages.len()), (expected.to_vec(), 1 + 7 + 2 * 3));
    let with_pixels = messages.iter().filter(|m| m.data.windows(12).any(|bytes| bytes == [2; 12]));
    assert_eq!(with_pixels.count(), 1);
}
