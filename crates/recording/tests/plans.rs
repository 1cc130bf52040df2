//! Round trip of an episode's plans, and refusals of other files.

#![expect(clippy::unwrap_used, reason = "a test")]

use mcap::MessageStream;
use recording::plans::{Exchange, Plans, from_bytes, to_bytes};
use std::time::Duration;
use wire::planner::{Goal, PlanRequest, PlanResponse, StageTimes};
use wire::replay::PlannedEpisode;
use wire::sim::Variation;
use wire::{Image, Observation};

fn picture(shade: u8) -> Image {
    Image::new(2, 2, vec![shade; 12]).unwrap()
}

fn exchange(step: u8) -> Exchange {
    let goal: Observation = picture(255).into();
    let request = PlanRequest {
        model: "cpn".into(),
        goal: Goal::Id(goal.digest()),
        observation: picture(step).into(),
        seed: step.into(),
        deadline: Some(Duration::from_secs(1)),
        model_digest: None,
        search: None,
        warm_start: vec![vec![0.5, -0.0]],
        steps_left: Some(70 - u32::from(step)),
    };
    let response = PlanResponse {
        actions: vec![vec![1.5, -0.0], vec![0.0, f32::MIN_POSITIVE]],
        first_action: vec![1.0, -0.0],
        inner_losses: vec![2.0, f32::from(step)],
        latent_distance: Some(0.0),
        times: StageTimes { queue_seconds: 0.1, encode_seconds: 0.2, plan_seconds: 0.3 },
        model_digest: "a".repeat(64),
        goal_id: goal.digest(),
        iterations: 1,
        iterations_run: 1,
        warm_start: vec![vec![0.0, 1.0]],
    };
    let asked = Duration::from_millis(100 * u64::from(step));
    Exchange { request, asked, response, answered: asked + Duration::from_nanos(7) }
}

fn episode(plans: u32) -> PlannedEpisode {
    PlannedEpisode {
        variation: Variation { task: "reach".into(), seed: 5 },
        model: "cpn".into(),
        model_digest: "a".repeat(64),
        goal: picture(255).into(),
        plans,
    }
}

fn exchanges() -> Vec<Exchange> {
    (0..3).map(exchange).collect()
}

#[test]
fn plans_round_trip() {
    let plans = Plans::new(episode(3), exchanges()).unwrap();
    let read = from_bytes(&to_bytes(&plans).unwrap()).unwrap();
    assert_eq!(read, plans);
    // Equality alone would take -0 for 0.
    let bits = |plans: &Plans| -> Vec<u32> {
        plans.exchanges().iter().flat_map(|e| e.response.actions.concat()).map(f32::to_bits).collect()
    };
    assert_eq!(bits(&read), bits(&plans));
}

#[test]
fn a_truncated_file_is_refused() {
    let good = to_bytes(&Plans::new(episode(3), exchanges()).unwrap()).unwrap();
    for length in (0..good.len()).step_by(41) {
        assert!(from_bytes(&good[..length]).is_err(), "{length}");
    }
}

#[test]
fn inconsistent_plans_are_refused_with_the_field() {
    type Spoil = fn(&mut PlannedEpisode, &mut Vec<Exchange>);
    let cases: [(Spoil, &str); 4] = [
        (|_, e| drop(e.pop()), "plans: expected 3, got 2"),
        (|_, e| e[1].request.model = "upn".into(), "plans[1].request.model: expected cpn, got upn"),
        (|i, _| i.goal = picture(9).into(), "plans[0].request.goal: expected "),
        (|_, e| e[2].response.model_digest = "b".repeat(64), "plans[2].response.model_digest: expected aaa"),
    ];
    for (spoil, expected) in cases {
        let (mut episode, mut exchanges) = (episode(3), exchanges());
        spoil(&mut episode, &mut exchanges);
        let error = Plans::new(episode, exchanges).unwrap_err().to_string();
        assert!(error.starts_with(expected), "{error:?} instead of {expected:?}");
    }
}

/// A file of plans is refused as a demonstration, and the reverse.
#[test]
fn plans_and_demonstrations_are_not_confused() {
    let plans = to_bytes(&Plans::new(episode(3), exchanges()).unwrap()).unwrap();
    let error = recording::from_bytes(&plans).unwrap_err().to_string();
    let expected = "cpn.v1.RecordedEpisode as protobuf, got cpn.v1.PlannedEpisode as protobuf";
    assert_eq!(error, format!("recording: /episode.schema: expected {expected}"));
}

/// View of any MCAP library: topics with schemas, and messages with log times.
#[test]
fn any_mcap_library_reads_it() {
    let bytes = to_bytes(&Plans::new(episode(3), exchanges()).unwrap()).unwrap();
    let messages: Vec<_> = MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
    let told: Vec<_> = messages[..4]
        .iter()
        .map(|m| (m.channel.topic.as_str(), m.channel.schema.as_ref().unwrap().name.as_str(), m.sequence, m.log_time))
        .collect();
    let expected = [
        ("/episode", "cpn.v1.PlannedEpisode", 0, 0),
        ("/plan/request", "cpn.v1.PlanRequest", 0, 0),
        ("/plan/response", "cpn.v1.PlanResponse", 0, 7),
        ("/plan/request", "cpn.v1.PlanRequest", 1, 100_000_000),
    ];
    assert_eq!((told, messages.len()), (expected.to_vec(), 7));
}
