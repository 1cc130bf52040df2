//! Episodes that an evaluation recorded are played back through planners, and so are files that are not right.

use crate::common::{LIMIT, Lab};
use recording::trial::{self, Exchange, Recording};
use service_kit::SessionConfig;
use std::path::PathBuf;
use std::time::Duration;
use wire::planner::{Search, Solver};
use wire::sim::{Control, ResetRequest, ResetResponse, StepRequest, StepResponse};
use wire::{Image, Position, key, query};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::query::Query;

/// Steps of every episode.
const STEPS: u32 = 4;

/// A picture whose pixels follow from `seed`.
fn picture(seed: u32) -> Image {
    let pixels = (0..84 * 84 * 3u32).map(|i| (i.wrapping_mul(seed + 31) >> 3) as u8).collect();
    Image::new(84, 84, pixels).unwrap()
}

fn hand(step: u32) -> Position {
    Position::new([0.5, 0.1 * step as f32, 0.2]).unwrap()
}

/// A worker whose episodes show a picture after another; those of Jenga have a position as their goal.
async fn worker(lab: &Lab) -> Session {
    let (connect, namespace) = (vec![lab.endpoint.clone()], Some(lab.namespace.clone()));
    let config = SessionConfig { connect, namespace, ..Default::default() };
    let session = service_kit::session::open(&config).await.unwrap();
    let serve = async |key: OwnedKeyExpr, answer: fn(&Query)| {
        session.declare_queryable(key).complete(true).callback(move |query| answer(&query)).background().await.unwrap();
    };
    serve(key::sim_reset("w").unwrap(), |query| {
        let task = query::request::<ResetRequest>(query).unwrap().variation.task;
        let is_position = task.starts_with("jenga");
        let response = ResetResponse {
            episode_id: task,
            goal: picture(99),
            observation: picture(0),
            max_steps: STEPS,
            goal_position: is_position.then(|| Position::new([0.7, -0.1, 0.2]).unwrap()),
            hand_position: hand(0),
            goal_hand_position: hand(STEPS),
            success: false,
            progress: 0.0,
            control: Control { action_size: if is_position { 3 } else { 4 }, metres: 0.01, hz: 10.0 },
        };
        query::reply(query, Ok(response)).unwrap();
    })
    .await;
    serve(key::sim_step("w").unwrap(), |query| {
        let StepRequest { step, .. } = query::request(query).unwrap();
        let response = StepResponse {
            observation: picture(step + 1),
            reward: 0.0,
            success: false,
            done: step + 1 == STEPS,
            hand_position: hand(step + 1),
            progress: 0.0,
        };
        query::reply(query, Ok(response)).unwrap();
    })
    .await;
    session
}

/// A lab, and the file of an episode of `model` that its planner has planned.
async fn recorded(task: &str, model: &str) -> (Lab, PathBuf) {
    let lab = Lab::start(0).await;
    let session = worker(&lab).await;
    let alive = session.liveliness().declare_token(key::sim_alive("w").unwrap()).await.unwrap();
    assert!(lab.evaluate(&["--tasks", task, "--models", model, "--trials", "1"]).await.success);
    alive.undeclare().await.unwrap();
    let file = lab.out().join(format!("trials/{task}/{model}/1000000.mcap"));
    (lab, file)
}

fn with_exchanges(recorded: &Recording, exchanges: Vec<Exchange>) -> Recording {
    Recording::new(recorded.trial().clone(), recorded.frames().to_vec(), exchanges).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn an_episode_comes_back_bit_for_bit() {
    for (task, model) in [("reach", "cpn"), ("jenga-poke", "jenga"), ("reach", "random")] {
        let (mut lab, file) = recorded(task, model).await;
        let recorded = trial::read(&file).unwrap();
        assert_eq!((recorded.trial().variation.task.as_str(), recorded.trial().plans), (task, STEPS));
        let pictures: Vec<_> = (0..=STEPS).map(picture).collect();
        let frames = recorded.frames().iter().map(|frame| frame.image.clone());
        assert_eq!(frames.collect::<Vec<_>>(), pictures, "with every frame");
        // A planner that has just started has never seen the goal.
        for lab in [&mut lab, &mut Lab::start(0).await] {
            let ended = lab.replay(&file).await;
            assert_eq!((ended.success, ended.stdout.as_str()), (true, "4 plans: bit for bit the same\n"));
            lab.stop_planner().await;
        }
    }
}

/// However many iterations the deadline left time for.
#[tokio::test(flavor = "multi_thread")]
async fn a_search_until_its_deadline_comes_back() {
    let (mut lab, file) = recorded("reach", "cpn").await;
    let recorded = trial::read(&file).unwrap();
    let mut exchanges = recorded.exchanges().to_vec();
    let session = worker(&lab).await;
    let planners =
        session.liveliness().declare_subscriber(key::planner_alive("*").unwrap()).history(true).await.unwrap();
    planners.recv_async().await.unwrap();
    for (exchange, solver) in exchanges.iter_mut().zip([Solver::Gradient, Solver::Cem, Solver::Mppi, Solver::Hybrid]) {
        let samples = (solver != Solver::Gradient).then_some(8);
        exchange.request.search = Some(Search { solver, iterations: None, samples, anytime: true });
        exchange.request.deadline = Some(Duration::from_secs(1));
        let plan = key::planner_plan("planner").unwrap();
        exchange.response = query::call(&session, &plan, exchange.request.clone(), LIMIT).await.unwrap();
    }
    let searched = with_exchanges(&recorded, exchanges);
    std::fs::write(&file, trial::to_bytes(&searched).unwrap()).unwrap();
    let ended = lab.replay(&file).await;
    assert_eq!((ended.success, ended.stdout.as_str()), (true, "4 plans: bit for bit the same\n"));
    lab.stop_planner().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_first_difference_is_shown() {
    let (mut lab, file) = recorded("reach", "cpn").await;
    let recorded = trial::read(&file).unwrap();
    let mut exchanges = recorded.exchanges().to_vec();
    let value = &mut exchanges[2].response.actions[1][3];
    let now = *value;
    *value = f32::from_bits(value.to_bits() ^ 1);
    let before = *value;
    exchanges[3].response.actions[0][0] = 0.5;
    let spoiled = with_exchanges(&recorded, exchanges);
    std::fs::write(&file, trial::to_bytes(&spoiled).unwrap()).unwrap();
    let ended = lab.replay(&file).await;
    let expected = format!("step 2 of 4: actions[1][3]: recorded {before}, now {now}\n");
    assert_eq!((ended.success, ended.stdout), (false, expected));
    lab.stop_planner().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn another_checkpoint_and_spoiled_files_are_refused() {
    let (mut lab, file) = recorded("reach", "cpn").await;
    let digest = trial::read(&file).unwrap().trial().model_digest.clone();
    let mut other = Lab::start(1).await;
    let ended = other.replay(&file).await;
    assert!(!ended.success && ended.stdout.is_empty());
    assert!(ended.stderr.contains("step 0") && ended.stderr.contains("model_digest: expected "), "{}", ended.stderr);
    assert!(ended.stderr.contains(&format!("which is served, or one of 0 kept before, got {digest}")));

    let bytes = std::fs::read(&file).unwrap();
    std::fs::write(&file, &bytes[..bytes.len() / 2]).unwrap();
    let ended = lab.replay(&file).await;
    assert!(!ended.success && ended.stderr.contains("1000000.mcap"), "{}", ended.stderr);
    assert!(ended.stderr.contains("recording: "), "{}", ended.stderr);
    let ended = lab.replay(&file.with_extension("json")).await;
    assert!(!ended.success && ended.stderr.contains("recording: Bad magic number"), "{}", ended.stderr);
    other.stop_planner().await;
    lab.stop_planner().await;
}
