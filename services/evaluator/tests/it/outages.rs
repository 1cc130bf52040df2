//! Evaluations through a router, planners and workers that come and go.

use crate::common::{self, Ended, LIMIT};
use planner::Planner;
use recording::trial;
use service_kit::SessionConfig;
use service_kit::session::Mode;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;
use std::time::Duration;
use tokio::process::Command;
use tokio::time::{sleep, timeout};
use wire::planner::{CheckpointSource, LoadModelRequest, PlanRequest, PlanResponse};
use wire::sim::{Control, ResetRequest, ResetResponse, StepRequest, StepResponse};
use wire::{Code, Error, Image, Position, key, query};
use zenoh::Session;
use zenoh::query::Query;

/// Steps of an episode that is not solved.
const MAX_STEPS: u32 = 8;

/// A session that talks through the router at an endpoint.
fn client(endpoint: &str) -> SessionConfig {
    SessionConfig { mode: Some(Mode::Client), connect: vec![endpoint.into()], ..Default::default() }
}

/// The router of an endpoint, even if that was in use a moment ago.
async fn router(endpoint: &str) -> Session {
    let config = SessionConfig { mode: Some(Mode::Router), listen: vec![endpoint.into()], ..Default::default() };
    let open = async {
        loop {
            match service_kit::session::open(&config).await {
                Ok(session) => return session,
                Err(_) => sleep(Duration::from_millis(50)).await,
            }
        }
    };
    timeout(LIMIT, open).await.expect("the router's port is free again")
}

async fn planner(endpoint: &str, models_dir: &Path, name: &str) -> Planner {
    let (name, models_dir, session) = (name.into(), models_dir.into(), client(endpoint));
    let grpc_listen = "127.0.0.1:0".parse().unwrap();
    planner::start(planner::Config { name, models_dir, grpc_listen, session, ..Default::default() }).await.unwrap()
}

fn evaluation(endpoint: &str, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-eval"));
    command.args(["run", "--mode", "client", "--connect", endpoint, "--tasks", "reach,door-lock"]).args(arguments);
    command.kill_on_drop(true).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// A stand-in for a simulator whose pictures and outcome follow from the variation and every action so far: an action that
/// is left out, applied twice or stale changes all that comes after it.
struct Simulator {
    name: String,
    resets: usize,
    episode: Option<Episode>,
    levers: Arc<Levers>,
}

/// What a test sees and does of a simulator.
#[derive(Default)]
struct Levers {
    /// Steps so far.
    applied: AtomicUsize,
    /// Whether the next step is not to come to its end.
    hold: AtomicBool,
    /// Whether one is held.
    held: AtomicBool,
}

struct Episode {
    id: String,
    state: u64,
    steps: u32,
    latest: Option<(StepRequest, StepResponse)>,
}

/// FNV-1a.
fn hash(state: u64, bytes: impl IntoIterator<Item = u8>) -> u64 {
    bytes.into_iter().fold(state, |state, byte| (state ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

fn picture(state: u64) -> Image {
    let pixels = (0..84 * 84 * 3u64).map(|i| (i.wrapping_mul(state | 1) >> 17) as u8).collect();
    Image::new(84, 84, pixels).unwrap()
}

fn origin() -> Position {
    Position::new([0.0; 3]).unwrap()
}

impl Simulator {
    fn reset(&mut self, ResetRequest { variation, .. }: ResetRequest) -> ResetResponse {
        self.resets += 1;
        let state = hash(variation.seed ^ 0xcbf2_9ce4_8422_2325, variation.task.bytes());
        let id = format!("{}-{}-{}", self.name, std::process::id(), self.resets);
        self.episode = Some(Episode { id: id.clone(), state, steps: 0, latest: None });
        ResetResponse {
            episode_id: id,
            goal: picture(state.rotate_left(32)),
            observation: picture(state),
            max_steps: MAX_STEPS,
            goal_position: None,
            hand_position: origin(),
            goal_hand_position: origin(),
            success: false,
            progress: 0.0,
            control: Control { action_size: 4, metres: 0.01, hz: 80.0 },
        }
    }

    /// As the real one: each step once, the latest one answered again.
    fn step(&mut self, request: StepRequest) -> Result<StepResponse, Error> {
        let episode = self.episode.as_mut().filter(|episode| episode.id == request.episode_id);
        let episode = episode.ok_or_else(|| Error::new(Code::NotFound, "episode_id", "mine", &request.episode_id))?;
        if let Some((latest, response)) = &episode.latest
            && *latest == request
        {
            return Ok(response.clone());
        }
        if request.step != episode.steps {
            return Err(Error::new(Code::FailedPrecondition, "step", episode.steps, request.step));
        }
        // Simulation takes time, in which things can happen.
        std::thread::sleep(Duration::from_millis(20));
        while self.levers.hold.load(Ordering::SeqCst) {
            self.levers.held.store(true, Ordering::SeqCst);
            std::thread::sleep(Duration::from_millis(1));
        }
        episode.steps += 1;
        episode.state = hash(episode.state, request.action.iter().flat_map(|value| value.to_le_bytes()));
        let success = episode.state.is_multiple_of(16);
        let response = StepResponse {
            observation: picture(episode.state),
            reward: 0.0,
            success,
            done: success || episode.steps == MAX_STEPS,
            hand_position: origin(),
            progress: f64::from((episode.state >> 48) as u16) / f64::from(u16::MAX),
        };
        episode.latest = Some((request, response.clone()));
        self.levers.applied.fetch_add(1, Ordering::SeqCst);
        Ok(response)
    }
}

/// A worker of the network: as it is started anew, it knows of no episode. Closing its session kills it.
async fn worker(endpoint: &str, name: &str) -> (Session, Arc<Levers>) {
    enum Asked {
        Reset(Query),
        Step(Query),
    }
    let session = service_kit::session::open(&client(endpoint)).await.unwrap();
    let (sender, receiver) = mpsc::channel();
    let resets = sender.clone();
    let queryable = session.declare_queryable(key::sim_reset(name).unwrap()).complete(true);
    queryable.callback(move |query| drop(resets.send(Asked::Reset(query)))).background().await.unwrap();
    let queryable = session.declare_queryable(key::sim_step(name).unwrap()).complete(true);
    queryable.callback(move |query| drop(sender.send(Asked::Step(query)))).background().await.unwrap();
    let levers = Arc::<Levers>::default();
    let mut simulator = Simulator { name: name.into(), resets: 0, episode: None, levers: levers.clone() };
    std::thread::spawn(move || {
        // An answer may find nobody: its router or its asker is away.
        for asked in receiver {
            let _ = match asked {
                Asked::Reset(query) => query::reply(&query, query::request(&query).map(|it| simulator.reset(it))),
                Asked::Step(query) => query::reply(&query, query::request(&query).and_then(|it| simulator.step(it))),
            };
        }
    });
    let token = session.liveliness().declare_token(key::sim_alive(name).unwrap()).await.unwrap();
    // It lives as long as the session.
    std::mem::forget(token);
    (session, levers)
}

async fn wait_until(what: &str, condition: impl Fn() -> bool) {
    let reached = async {
        while !condition() {
            sleep(Duration::from_millis(5)).await;
        }
    };
    timeout(LIMIT, reached).await.expect(what);
}

/// Waits until workers have applied ten more steps.
async fn ten_steps(workers: &[&Levers]) {
    let count = || workers.iter().map(|worker| worker.applied.load(Ordering::SeqCst)).sum::<usize>();
    let enough = count() + 10;
    wait_until("the evaluation goes on", || count() >= enough).await;
}

type Exchanges = Vec<(PlanRequest, PlanResponse)>;

/// The records and the plans of a run without times, by path.
fn results(out: &Path) -> BTreeMap<PathBuf, (serde_json::Value, Exchanges)> {
    let mut results = BTreeMap::new();
    let list = |folder: &Path| std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let trials = out.join("trials");
    for path in list(&trials).flat_map(|task| list(&task).collect::<Vec<_>>()).flat_map(|model| list(&model)) {
        if path.extension().unwrap() != "json" {
            continue;
        }
        let mut record: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        record["episode"].as_object_mut().expect("an episode").remove("mean_times").unwrap();
        let recorded = trial::read(&path.with_extension(recording::EXTENSION)).unwrap();
        let timeless = |plan: &PlanResponse| PlanResponse { times: Default::default(), ..plan.clone() };
        let exchanges = recorded.exchanges().iter().map(|it| (it.request.clone(), timeless(&it.response))).collect();
        results.insert(path.strip_prefix(out).unwrap().to_owned(), (record, exchanges));
    }
    results
}

#[tokio::test(flavor = "multi_thread")]
async fn results_through_outages_are_those_without() {
    let folder = tempfile::tempdir().unwrap();
    let models = common::models(folder.path(), 0);
    let endpoint = common::free_endpoint();
    let mut the_router = router(&endpoint).await;
    let first_planner = planner(&endpoint, &models, "planner-0").await;
    let second_planner = planner(&endpoint, &models, "planner-1").await;
    let (_w0, steady) = worker(&endpoint, "w0").await;
    let (w1, doomed) = worker(&endpoint, "w1").await;
    let out = |name: &str| folder.path().join(name);
    let run = |out: &Path| {
        let mut command = evaluation(&endpoint, &["--models", "cpn,random", "--planner", "planner-0,planner-1"]);
        command
            .args(["--workers", "2", "--trials", "16", "--wait-secs", "120", "--timeout-secs", "60", "--out"])
            .arg(out);
        command
    };

    let calm = Ended::of(run(&out("calm")).output()).await;
    assert!(calm.success);
    assert!(!calm.stderr.contains("begins anew"), "{}", calm.stderr);

    let rough = run(&out("rough")).spawn().unwrap();
    // Outages of the router, shorter and longer.
    for milliseconds in [0, 200, 600, 1500] {
        ten_steps(&[&steady, &doomed]).await;
        the_router.close().await.unwrap();
        sleep(Duration::from_millis(milliseconds)).await;
        the_router = router(&endpoint).await;
    }
    // A worker is killed in the middle of a step, and has forgotten its episode when it is back. The router is away meanwhile, so
    // that the evaluator only hears of a worker that is alive.
    doomed.hold.store(true, Ordering::SeqCst);
    wait_until("a step is held", || doomed.held.load(Ordering::SeqCst)).await;
    the_router.close().await.unwrap();
    w1.close().await.unwrap();
    doomed.hold.store(false, Ordering::SeqCst);
    the_router = router(&endpoint).await;
    let (w1, doomed) = worker(&endpoint, "w1").await;
    ten_steps(&[&doomed]).await;
    // One of two planners goes.
    second_planner.shutdown().await.unwrap();
    ten_steps(&[&steady, &doomed]).await;
    // The worker dies again, and stays away; another one joins in.
    w1.close().await.unwrap();
    ten_steps(&[&steady]).await;
    let (_w2, joined) = worker(&endpoint, "w2").await;
    // The last planner comes back without the goals that it knew.
    ten_steps(&[&steady, &joined]).await;
    first_planner.shutdown().await.unwrap();
    let first_planner = planner(&endpoint, &models, "planner-0").await;
    let rough = Ended::of(rough.wait_with_output()).await;

    assert!(rough.success);
    let lost = "worker w1: episode_id: expected mine, got ";
    assert!(rough.stderr.lines().any(|line| line.contains(lost) && line.contains("begins anew")), "{}", rough.stderr);
    let (expected, got) = (results(&out("calm")), results(&out("rough")));
    assert_eq!(expected.len(), 2 * 2 * 16);
    let outcomes = |outcome: &str| expected.values().filter(|(record, _)| record["outcome"] == outcome).count();
    assert!(outcomes("success") > 0 && outcomes("failure") > 0, "episodes end in either way");
    assert_eq!(got.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (path, (record, exchanges)) in &expected {
        assert_eq!(got[path].0, *record, "{}", path.display());
        assert!(got[path].1 == *exchanges, "{}: the plans differ", path.display());
    }
    assert_eq!(rough.stdout, calm.stdout, "the tables are the same");
    first_planner.shutdown().await.unwrap();
    the_router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_router_and_planners_that_differ_are_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let endpoint = common::free_endpoint();
    let arguments = ["--planner", "planner-0,planner-1", "--out", out.to_str().unwrap()];
    let ended = Ended::of(evaluation(&endpoint, &arguments).args(["--wait-secs", "1"]).output()).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains(&format!("no router at {endpoint} within 1 s: is it running")), "{}", ended.stderr);

    let names = ["one", "two"].map(|name| folder.path().join(name));
    let models = [0, 1].map(|seed| {
        std::fs::create_dir(&names[seed as usize]).unwrap();
        common::models(&names[seed as usize], seed)
    });
    let mut waits = evaluation(&endpoint, &arguments);
    let waits = waits.args(["--wait-secs", "120", "--models", "cpn", "--trials", "1"]).spawn().unwrap();
    let the_router = router(&endpoint).await;
    let _worker = worker(&endpoint, "w0").await;
    let planners =
        [planner(&endpoint, &models[0], "planner-0").await, planner(&endpoint, &models[1], "planner-1").await];
    let elsewhere = folder.path().join("elsewhere");
    let arguments = ["--planner", "planner-0,planner-1", "--out", elsewhere.to_str().unwrap()];
    let refused =
        |models| Ended::of(evaluation(&endpoint, &arguments).args(["--wait-secs", "3", "--models", models]).output());
    let ended = refused("cpn").await;
    assert!(!ended.success);
    let expected = "--planner: expected planner \"planner-1\" to serve cpn from checkpoint ";
    assert!(ended.stderr.contains(expected), "{}", ended.stderr);
    assert!(ended.stderr.contains("as planner \"planner-0\" does, got "), "{}", ended.stderr);
    let ended = refused("nobodys").await;
    assert!(ended.stderr.contains("serves cpn, jenga, random; got nobodys"), "{}", ended.stderr);
    assert!(
        !ended.stderr.contains("waiting up to 3 s: --"),
        "a name that nobody serves is not waited for: {}",
        ended.stderr
    );

    std::fs::copy(models[0].join("cpn.safetensors"), models[1].join("cpn-of-0.safetensors")).unwrap();
    let source = CheckpointSource::File("cpn-of-0.safetensors".into());
    let load = LoadModelRequest { model: "cpn".into(), source };
    planners[1].core().load_model(load).await.unwrap();
    let ended = Ended::of(waits.wait_with_output()).await;
    assert!(ended.success, "{}", ended.stderr);
    assert!(ended.stderr.contains(&format!("waiting up to 120 s: {expected}")), "{}", ended.stderr);
    for planner in planners {
        planner.shutdown().await.unwrap();
    }
    the_router.close().await.unwrap();
}
