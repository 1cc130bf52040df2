//! Soak test: plans, goals, swaps, malformed requests and vanishing clients at once, against a planner in a process of its own.
//! No valid request may fail, and memory may not grow.

use crate::common::{NAME, Program, checkpoint, connected, from_bytes, image, plan_request};
use cpn::MethodKind;
use prost::Message as _;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};
use testing::process::Process;
use tokio::task::JoinSet;
use tonic::transport::Channel;
use wire::planner::{PlanRequest, PlanResponse, RegisterGoalRequest, RegisterGoalResponse};
use wire::proto::plan_request::Goal;
use wire::proto::planner_service_client::PlannerServiceClient;
use wire::{Code, Error, decode, key, proto, query};
use zenoh::Session;

const TIMEOUT: Duration = Duration::from_secs(30);
/// Largest growth of memory between a tenth of the long run and its end.
const MOST_GROWTH_BYTES: u64 = 20 << 20;

/// Resident memory of a process, in bytes.
fn resident_bytes(process: &Process) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", process.0.id())).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() << 10
}

/// Shared state of all clients.
#[derive(Clone)]
struct Load {
    endpoint: String,
    grpc: String,
    end: Instant,
    /// Numbers of requests, by kind.
    done: Arc<BTreeMap<&'static str, AtomicU64>>,
}

impl Load {
    fn goes_on(&self, kind: &str) -> bool {
        self.done[kind].fetch_add(1, Ordering::Relaxed);
        Instant::now() < self.end
    }

    async fn session(&self) -> Session {
        connected(&self.endpoint).await
    }

    async fn channel(&self) -> PlannerServiceClient<Channel> {
        PlannerServiceClient::connect(self.grpc.clone()).await.unwrap()
    }
}

/// Random valid request, with any goal and search.
fn valid(rng: &mut ChaCha8Rng) -> proto::PlanRequest {
    let model = if rng.random_bool(0.8) { "cpn" } else { "te-bc" };
    let search = (model == "cpn" && rng.random_bool(0.3)).then(|| proto::Search {
        solver: rng.random_range(1..=4),
        iterations: Some(rng.random_range(0..3)),
        ..Default::default()
    });
    proto::PlanRequest {
        goal: Some(Goal::GoalImage(image(rng.random_range(0..5000)))),
        search,
        ..plan_request(model, rng.random_range(0..1000))
    }
}

async fn plans_over_zenoh(load: Load, mut rng: ChaCha8Rng) {
    let session = load.session().await;
    while load.goes_on("zenoh plans") {
        let request = PlanRequest::try_from(valid(&mut rng)).unwrap();
        let answer: PlanResponse =
            query::call(&session, &key::planner_plan(NAME).unwrap(), request, TIMEOUT).await.unwrap();
        assert!(answer.actions.iter().flatten().all(|value| value.is_finite()));
    }
}

async fn plans_over_grpc(load: Load, mut rng: ChaCha8Rng) {
    let mut grpc = load.channel().await;
    while load.goes_on("gRPC plans") {
        grpc.plan(valid(&mut rng)).await.unwrap();
    }
}

async fn goals(load: Load, mut rng: ChaCha8Rng) {
    let session = load.session().await;
    while load.goes_on("goals") {
        let request = RegisterGoalRequest { image: image(rng.random_range(0..u64::MAX)).try_into().unwrap() };
        let key = key::planner_register_goal(NAME).unwrap();
        let goal: RegisterGoalResponse = query::call(&session, &key, request, TIMEOUT).await.unwrap();
        let request = proto::PlanRequest { goal: Some(Goal::GoalId(goal.goal_id)), ..valid(&mut rng) };
        let request = PlanRequest::try_from(request).unwrap();
        let _: PlanResponse = query::call(&session, &key::planner_plan(NAME).unwrap(), request, TIMEOUT).await.unwrap();
    }
}

async fn swaps(load: Load, _: ChaCha8Rng) {
    let mut grpc = load.channel().await;
    let checkpoints = [1, 2, 3, 4, 5].map(|seed| checkpoint(MethodKind::Cpn, seed));
    for turn in 0.. {
        if !load.goes_on("swaps") {
            return;
        }
        grpc.load_model(from_bytes("cpn", checkpoints[turn % 5].clone())).await.unwrap();
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

async fn malformed(load: Load, mut rng: ChaCha8Rng) {
    let (session, mut grpc) = (load.session().await, load.channel().await);
    while load.goes_on("malformed") {
        let mut bytes = valid(&mut rng).encode_to_vec();
        bytes.truncate(rng.random_range(1..bytes.len()));
        for _ in 0..rng.random_range(0..20) {
            let at = rng.random_range(0..bytes.len());
            bytes[at] = rng.random();
        }
        let is_wrong = decode::<PlanRequest>(&bytes).is_err();
        let replies = session.get(key::planner_plan(NAME).unwrap()).payload(bytes).timeout(TIMEOUT).await.unwrap();
        let reply = replies.recv_async().await.unwrap().into_result();
        assert!(reply.is_err() || !is_wrong, "an unreadable request was answered");
        let mut request = valid(&mut rng);
        request.model = "../etc/passwd".into();
        let error = Error::from(grpc.plan(request).await.unwrap_err());
        assert_eq!((error.code, error.field.as_str()), (Code::InvalidArgument, "model"));
        grpc.load_model(from_bytes("cpn", vec![rng.random(); 64])).await.unwrap_err();
    }
}

async fn vanishing(load: Load, mut rng: ChaCha8Rng) {
    while load.goes_on("vanishing") {
        let (session, mut grpc) = (load.session().await, load.channel().await);
        for _ in 0..5 {
            let wait = Duration::from_micros(rng.random_range(0..3000));
            let _ = tokio::time::timeout(wait, grpc.plan(valid(&mut rng))).await;
            let payload = valid(&mut rng).encode_to_vec();
            drop(session.get(key::planner_plan(NAME).unwrap()).payload(payload).await.unwrap());
        }
        drop(grpc);
        session.close().await.unwrap();
    }
}

/// Runs the load; returns the resident memory at a tenth of the time and at the end.
async fn soak(duration: Duration) -> (u64, u64) {
    let checkpoints = [("cpn", MethodKind::Cpn), ("te-bc", MethodKind::TeBc)];
    let checkpoints = checkpoints.map(|(name, method)| (name, checkpoint(method, 1)));
    let program = Program::start(&checkpoints, |command| {
        command.env("RUST_LOG", "error");
    })
    .await;
    let kinds = ["zenoh plans", "gRPC plans", "goals", "swaps", "malformed", "vanishing"];
    let done = Arc::new(kinds.map(|kind| (kind, AtomicU64::new(0))).into());
    let (endpoint, grpc) = (program.endpoint.clone(), format!("http://{}", program.grpc));
    let load = Load { endpoint, grpc, end: Instant::now() + duration, done };

    let mut clients = JoinSet::new();
    let rng = |seed| ChaCha8Rng::seed_from_u64(seed);
    for seed in 0..4 {
        clients.spawn(plans_over_zenoh(load.clone(), rng(seed)));
        clients.spawn(plans_over_grpc(load.clone(), rng(10 + seed)));
    }
    clients.spawn(goals(load.clone(), rng(20)));
    clients.spawn(swaps(load.clone(), rng(21)));
    clients.spawn(malformed(load.clone(), rng(22)));
    clients.spawn(vanishing(load.clone(), rng(23)));
    let (begun, mut early) = (Instant::now(), None);
    let mut tick = tokio::time::interval(duration / 50);
    while !clients.is_empty() {
        tokio::select! {
            _ = tick.tick() => {
                let bytes = resident_bytes(&program.process);
                if begun.elapsed() * 10 > duration {
                    early.get_or_insert(bytes);
                }
                let counts: Vec<_> = load.done.iter().map(|(kind, n)| format!("{kind} {}", n.load(Ordering::Relaxed))).collect();
                println!("{:5.0} s: {} MiB, {}", begun.elapsed().as_secs_f64(), bytes >> 20, counts.join(", "));
            }
            Some(ended) = clients.join_next() => ended.expect("no valid request fails"),
        }
    }
    for (kind, count) in &*load.done {
        assert!(count.load(Ordering::Relaxed) > 2, "{kind}: next to nothing was done");
    }
    (early.unwrap(), resident_bytes(&program.process))
}

#[tokio::test(flavor = "multi_thread")]
async fn a_mixed_load_is_served() {
    soak(Duration::from_secs(5)).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes half an hour: make test-soak"]
async fn a_mixed_load_is_served_for_half_an_hour() {
    let (early, late) = soak(Duration::from_secs(30 * 60)).await;
    assert!(late < early + MOST_GROWTH_BYTES, "memory grew from {early} to {late} bytes");
}
