//! Versions are promoted, announced, fetched and swapped in one after the other while clients plan: no plan fails, and each is,
//! to the bit, that of the checkpoint it names.

use crate::common::checkpoint;
use service_kit::SessionConfig;
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::task::JoinSet;
use trainer::{publish, service};
use wire::planner::{Goal, PlanRequest, PlanResponse};
use wire::{Image, key, query};
use zenoh::Session;

const MODEL: &str = "cpn";
const PLANNER: &str = "planner";
/// Number of plans of an episode.
const EPISODE: usize = 8;
/// Pause of a client between two plans.
const PAUSE: Duration = Duration::from_millis(5);
/// Timeout that no passing test reaches.
const PATIENCE: Duration = Duration::from_secs(60);

#[tokio::test(flavor = "multi_thread")]
async fn plans_during_swaps_are_of_one_checkpoint_each() {
    swap(50, "tcp/127.0.0.1:17481").await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "long; `make test-swap`"]
async fn plans_during_a_thousand_swaps_are_of_one_checkpoint_each() {
    swap(1000, "tcp/127.0.0.1:17482").await;
}

/// Planned actions of each checkpoint, by its digest.
type Expected = HashMap<String, Vec<Vec<f32>>>;

async fn swap(swaps: u32, endpoint: &str) {
    let folder = tempfile::tempdir().unwrap();
    let connecting = SessionConfig { connect: vec![endpoint.into()], ..SessionConfig::default() };
    let trainer = service::start(service::Config {
        dataset: folder.path().join("data"),
        checkpoints: folder.path().join("checkpoints"),
        runs: folder.path().join("runs"),
        grpc_listen: "127.0.0.1:0".parse().unwrap(),
        session: SessionConfig { listen: vec![endpoint.into()], ..SessionConfig::default() },
        ..service::Config::default()
    });
    let trainer = trainer.await.unwrap();
    std::fs::create_dir(folder.path().join("none")).unwrap();
    let planner = planner::start(planner::Config {
        name: PLANNER.into(),
        models_dir: folder.path().join("none"),
        grpc_listen: "127.0.0.1:0".parse().unwrap(),
        session: connecting.clone(),
        ..planner::Config::default()
    });
    let planner = planner.await.unwrap();
    let core = planner.core();
    let served = async |version: u32| {
        let poll = async {
            while !core.list_models().models.iter().any(|info| info.name == MODEL && info.version == version) {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::time::timeout(PATIENCE, poll).await.unwrap_or_else(|_| panic!("version {version} is not served"));
    };

    let session = joined(&connecting).await;
    let mut expected = Expected::new();
    for version in 1..=2 {
        let path = folder.path().join(format!("checkpoints/{MODEL}.safetensors"));
        service_kit::files::write_atomically(&path, &checkpoint(version.into())).unwrap();
        served(version).await;
        let plan = core.plan(request(None)).await.unwrap();
        expected.insert(plan.model_digest, plan.actions);
    }
    assert_eq!(expected.values().collect::<Vec<_>>().windows(2).filter(|pair| pair[0] != pair[1]).count(), 1);

    let (expected, done) = (Arc::new(expected), Arc::new(AtomicBool::new(false)));
    let mut clients = JoinSet::new();
    for client in 0..4 {
        let session = joined(&connecting).await;
        let (expected, done) = (Arc::clone(&expected), Arc::clone(&done));
        clients.spawn(async move {
            let mut answers = Answers::default();
            while !done.load(Ordering::Relaxed) || answers.plans == 0 {
                answers.add(&episode(&session, &expected, client % 2 == 0).await);
            }
            session.close().await.unwrap();
            answers
        });
    }
    for swap in 0..swaps {
        let version = 1 + swap % 2;
        let manifest = publish::promote(&session, MODEL.into(), version).await.unwrap();
        served(version).await;
        let plan = plan(&session, None).await;
        assert_eq!(plan.model_digest, manifest.digest, "swap {swap}");
        assert_eq!(plan.actions, expected[&plan.model_digest]);
    }
    done.store(true, Ordering::Relaxed);
    let mut all = Answers::default();
    while let Some(answers) = clients.join_next().await {
        let Answers { plans, mixed_episodes } = answers.unwrap();
        all = Answers { plans: all.plans + plans, mixed_episodes: all.mixed_episodes + mixed_episodes };
    }
    assert!(all.mixed_episodes > 0, "no swap fell into an episode: {all:?}");
    println!("{swaps} swaps, {} plans of 4 clients, none failed, none mixed", all.plans);
    session.close().await.unwrap();
    planner.shutdown().await.unwrap();
    trainer.shutdown().await.unwrap();
}

/// Session that has discovered the planner.
async fn joined(config: &SessionConfig) -> Session {
    let session = service_kit::session::open(config).await.unwrap();
    let token = key::planner_alive(PLANNER).unwrap();
    let alive = session.liveliness().declare_subscriber(token).history(true).await.unwrap();
    tokio::time::timeout(PATIENCE, alive.recv_async()).await.expect("a planner").unwrap();
    session
}

#[derive(Debug, Default)]
struct Answers {
    plans: usize,
    /// Episodes of clients that did not pin a checkpoint, and got several.
    mixed_episodes: usize,
}

impl Answers {
    fn add(&mut self, digests: &[String]) {
        self.plans += digests.len();
        self.mixed_episodes += usize::from(digests.windows(2).any(|pair| pair[0] != pair[1]));
    }
}

/// Digests of the checkpoints that answered an episode, whose plans are checked to be theirs; all the same if `pinned`.
async fn episode(session: &Session, expected: &Expected, pinned: bool) -> Vec<String> {
    let mut digests: Vec<String> = Vec::new();
    for _ in 0..EPISODE {
        let pin = digests.first().filter(|_| pinned).cloned();
        let plan = plan(session, pin.clone()).await;
        assert_eq!(plan.actions, expected[&plan.model_digest]);
        assert!(pin.is_none_or(|pin| pin == plan.model_digest), "an episode with two checkpoints");
        digests.push(plan.model_digest);
        tokio::time::sleep(PAUSE).await;
    }
    digests
}

async fn plan(session: &Session, model_digest: Option<String>) -> PlanResponse {
    let key = key::planner_plan(PLANNER).unwrap();
    query::call(session, &key, request(model_digest), PATIENCE).await.unwrap()
}

fn request(model_digest: Option<String>) -> PlanRequest {
    let image = |shade| Image::new(84, 84, vec![shade; cpn::images::BYTES]).unwrap();
    let (goal, observation) = (Goal::Image(image(255)), image(0));
    PlanRequest { model_digest, ..PlanRequest::new(MODEL, goal, observation.into()) }
}
