//! Service benchmark of `make bench-plan`: a planner in a process of its own, and clients with one plan request in flight each. A
//! measurement is a line of JSON; those of one turn and number of clients are adjacent, for comparison.

#![expect(clippy::unwrap_used, reason = "a bench")]

use clap::Parser;
use cpn::method::{Iterations, Observed, Query, Solver};
use cpn::{Method, Precision, checkpoint};
use futures::future::join_all;
use planner::core::PlannerCore;
use serde_json::{Value, json};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};
use tonic::transport::Channel;
use wire::planner::{Goal, PlanRequest, PlanResponse, RegisterGoalRequest, Search, StageTimes};
use wire::proto::planner_service_client::PlannerServiceClient;
use wire::{Code, Error, Image, key, proto, query};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;

const MODEL: &str = "cpn";
const NAME: &str = "bench";
const CLIENTS: [usize; 6] = [1, 2, 4, 8, 16, 32];
const PATIENCE: Duration = Duration::from_secs(30);
/// Deadline of a plan, that of a robot with ten actions per second.
const DEADLINE: Duration = Duration::from_millis(100);
/// Updates of a plan under overload, so many that the transport costs little compared with planning.
const HEAVY_UPDATES: u32 = 20;
const OVERLOAD: f64 = 4.0;

#[derive(Parser)]
struct Args {
    /// Output file of the measurements.
    #[arg(long)]
    out: PathBuf,
    /// Duration of each measurement.
    #[arg(long, default_value_t = 1.0)]
    seconds: f64,
    /// Number of turns.
    #[arg(long, default_value_t = 5)]
    turns: u32,
    /// Flag that `cargo bench` passes.
    #[arg(long, hide = true)]
    bench: bool,
}

/// Process of the planner, killed when dropped.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Planner in a process of its own.
struct Server {
    _process: Process,
    /// Addresses of zenoh and gRPC.
    endpoints: [String; 2],
    shared_memory: bool,
}

/// Client of one transport.
#[derive(Clone)]
enum Client {
    InProcess(PlannerCore),
    Zenoh(Session, OwnedKeyExpr),
    Grpc(PlannerServiceClient<Channel>),
}

impl Client {
    /// Opens a session as a robot does: in client mode, connected to the planner only.
    async fn zenoh(Server { endpoints: [endpoint, _], shared_memory, .. }: &Server) -> Self {
        let mut config = zenoh::Config::default();
        for (key, value) in [
            ("mode", json!("client")),
            ("connect/endpoints", json!([endpoint])),
            ("connect/timeout_ms", json!(PATIENCE.as_millis() as u64)),
            ("scouting/multicast/enabled", json!(false)),
            ("transport/shared_memory/enabled", json!(shared_memory)),
        ] {
            config.insert_json5(key, &value.to_string()).unwrap();
        }
        Self::Zenoh(zenoh::open(config).await.unwrap(), key::planner_plan(NAME).unwrap())
    }

    async fn grpc(Server { endpoints: [_, endpoint], .. }: &Server) -> Self {
        Self::Grpc(PlannerServiceClient::connect(endpoint.clone()).await.unwrap())
    }

    async fn plan(&self, request: PlanRequest) -> Result<PlanResponse, Error> {
        match self {
            Self::InProcess(core) => core.plan(request).await,
            Self::Zenoh(session, key) => query::call(session, key, request, PATIENCE).await,
            Self::Grpc(grpc) => grpc.clone().plan(proto::PlanRequest::from(request)).await?.into_inner().try_into(),
        }
    }
}

#[tokio::main]
async fn main() {
    let args = Args::parse();
    let mut out = File::create(&args.out).unwrap();
    let mut tell = |line: Value| {
        println!("{line}");
        writeln!(out, "{line}").unwrap();
    };
    let duration = Duration::from_secs_f64(args.seconds);
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");

    let (tcp, goal) = start(&models, false).await;
    let (shared, same_goal) = start(&models, true).await;
    let grpc_listen = ([127, 0, 0, 1], 0).into();
    let planner = planner::Config { models_dir: models.clone(), grpc_listen, ..Default::default() };
    let planner = planner::start(planner).await.unwrap();
    let here = planner.core().register_goal(RegisterGoalRequest { image: image(0) }).unwrap().goal_id;
    assert!(goal == same_goal && goal == here, "a goal's id is the digest of its image");

    // Once, since a planner keeps mapped what closed sessions shared (eclipse-zenoh/zenoh#2787).
    let sharing = join_all((0..CLIENTS[CLIENTS.len() - 1]).map(|_| Client::zenoh(&shared))).await;
    for (_, count) in (0..args.turns).flat_map(|turn| CLIENTS.map(|count| (turn, count))) {
        tell(batches(&models, count, duration));
        let clients = join_all((0..count).map(|_| Client::zenoh(&tcp))).await;
        tell(closed_loop("zenoh tcp", clients, &goal, duration).await);
        tell(closed_loop("zenoh shared memory", sharing[..count].to_vec(), &goal, duration).await);
        let clients = join_all((0..count).map(|_| Client::grpc(&tcp))).await;
        tell(closed_loop("gRPC", clients, &goal, duration).await);
        let clients = vec![Client::InProcess(planner.core()); count];
        tell(closed_loop("in-process service", clients, &goal, duration).await);
    }

    tell(overload(Client::zenoh(&tcp).await, &goal, duration * args.turns).await);
    planner.shutdown().await.unwrap();
}

/// Plans by the library in batches, without a service: the upper bound of the throughput.
fn batches(models: &Path, batch: usize, duration: Duration) -> Value {
    let bytes = std::fs::read(models.join(format!("{MODEL}.safetensors"))).unwrap();
    let mut planner = cpn::Planner::new(&checkpoint::from_bytes(&bytes).unwrap().model, Precision::Float32, 1);
    let (goal, frames): (Image, Vec<Image>) = (image(0), (1..=batch as u8).map(image).collect());
    let x_g = planner.encode(&[Observed::Image(goal.data())]).remove(0);
    let updates = planner.updates().unwrap();
    let (started, mut took) = (Instant::now(), Vec::new());
    while started.elapsed() < duration {
        let begun = Instant::now();
        let xs = planner.encode(&frames.iter().map(|frame| Observed::Image(frame.data())).collect::<Vec<_>>());
        let queries: Vec<_> = xs
            .iter()
            .map(|x| Query { x, x_g: &x_g, steps_left: 1, seed: 0, start: &[], keep_initial: false })
            .collect();
        let iterations = Iterations::Fixed(updates);
        planner.plan(&queries, &mut cpn::method::Search { solver: Solver::Gradient, iterations });
        took.push((begun.elapsed().as_secs_f64(), begun.elapsed().as_secs_f64()));
    }
    line("library", batch, batch * took.len(), started.elapsed(), &mut took)
}

/// Closed-loop clients, which send a request as soon as the last is answered.
async fn closed_loop(transport: &str, clients: Vec<Client>, goal: &str, duration: Duration) -> Value {
    let count = clients.len();
    let warm = Instant::now() + Duration::from_millis(300);
    let end = warm + duration;
    let run = |(index, client): (usize, Client)| {
        let goal = goal.to_owned();
        tokio::spawn(async move {
            let mut took = Vec::new();
            for frame in 0u64.. {
                let request = request(&goal, (index as u64 * 17 + frame) as u8);
                let asked = Instant::now();
                let StageTimes { queue_seconds, encode_seconds, plan_seconds } =
                    client.plan(request).await.unwrap().times;
                if asked > end {
                    break;
                }
                if asked > warm {
                    took.push((asked.elapsed().as_secs_f64(), queue_seconds + encode_seconds + plan_seconds));
                }
            }
            took
        })
    };

    let runs = join_all(clients.into_iter().enumerate().map(run)).await;
    let mut took: Vec<_> = runs.into_iter().flat_map(Result::unwrap).collect();
    line(transport, count, took.len(), duration, &mut took)
}

/// Overload: requests of slow plans with a deadline, at four times the rate that can be answered.
async fn overload(client: Client, goal: &str, duration: Duration) -> Value {
    let search = Search {
        solver: wire::planner::Solver::Gradient,
        iterations: Some(HEAVY_UPDATES),
        samples: None,
        anytime: false,
    };
    let heavy = |frame| PlanRequest { search: Some(search), ..request(goal, frame) };

    let (started, mut alone) = (Instant::now(), 0);
    while started.elapsed() < Duration::from_secs(1) {
        join_all((0..16).map(|frame| client.plan(heavy(frame)))).await.into_iter().for_each(|plan| drop(plan.unwrap()));
        alone += 16;
    }
    let capacity = f64::from(alone) / started.elapsed().as_secs_f64();

    let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / (OVERLOAD * capacity)));
    let (started, mut asked) = (Instant::now(), Vec::new());
    while started.elapsed() < duration {
        ticks.tick().await;
        let (client, request) = (client.clone(), PlanRequest { deadline: Some(DEADLINE), ..heavy(asked.len() as u8) });
        asked.push(tokio::spawn(async move {
            let asked = Instant::now();
            let answer = client.plan(request).await;
            (answer, asked.elapsed().as_secs_f64())
        }));
    }

    let answers: Vec<_> = join_all(asked).await.into_iter().map(Result::unwrap).collect();
    let seconds = |keep: &dyn Fn(&Result<PlanResponse, Error>) -> bool| {
        let mut kept: Vec<_> = answers.iter().filter(|(answer, _)| keep(answer)).map(|(_, seconds)| *seconds).collect();
        kept.sort_by(f64::total_cmp);
        kept
    };
    let refused = seconds(&|answer| answer.as_ref().is_err_and(|error| error.code == Code::ResourceExhausted));
    let (answered, all) = (seconds(&|answer| answer.is_ok()), answers.len());
    let in_time = answered.iter().filter(|seconds| **seconds <= DEADLINE.as_secs_f64()).count();
    json!({
        "overload": OVERLOAD, "capacity_plans_per_second": capacity, "deadline_ms": DEADLINE.as_millis() as u64, "n": all,
        "answered": answered.len(), "answered_in_time": in_time, "refused": refused.len(),
        "late": all - answered.len() - refused.len(),
        "refused_p50_ms": 1e3 * quantile(&refused, 0.5), "refused_p99_ms": 1e3 * quantile(&refused, 0.99),
    })
}

/// Starts a planner and registers a goal; returns the goal's id.
async fn start(models: &Path, shared_memory: bool) -> (Server, String) {
    let free = || std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let (zenoh, grpc) = (format!("tcp/{}", free()), free());
    let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-planner"));
    command.args(["--name", NAME, "--listen", &zenoh, "--grpc-listen", &grpc.to_string(), "--models-dir"]).arg(models);
    if shared_memory {
        command.arg("--shared-memory");
    }
    let process = Process(command.env("RUST_LOG", "warn").spawn().unwrap());
    let server = Server { _process: process, endpoints: [zenoh, format!("http://{grpc}")], shared_memory };
    let Client::Zenoh(session, _) = Client::zenoh(&server).await else { unreachable!("asked for") };
    let alive = session.liveliness().declare_subscriber(key::planner_alive(NAME).unwrap()).history(true).await.unwrap();
    tokio::time::timeout(PATIENCE, alive.recv_async()).await.unwrap().unwrap();
    let request = RegisterGoalRequest { image: image(0) };
    let key = key::planner_register_goal(NAME).unwrap();
    let response: wire::planner::RegisterGoalResponse = query::call(&session, &key, request, PATIENCE).await.unwrap();
    (server, response.goal_id)
}

fn request(goal: &str, frame: u8) -> PlanRequest {
    PlanRequest::new(MODEL, Goal::Id(goal.into()), image(frame).into())
}

/// Image that is distinct for each number.
fn image(number: u8) -> Image {
    let side = cpn::images::SIZE as u32;
    let data = (0..cpn::images::BYTES).map(|at| (at as u8).wrapping_mul(31) ^ number).collect();
    Image::new(side, side, data).unwrap()
}

/// Measurement of latencies, and of the service's own part of them, in seconds.
fn line(transport: &str, clients: usize, plans: usize, duration: Duration, took: &mut [(f64, f64)]) -> Value {
    let column = |of: fn(&(f64, f64)) -> f64| {
        let mut values: Vec<_> = took.iter().map(of).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let (latencies, server) = (column(|(latency, _)| *latency), column(|(_, server)| *server));
    json!({
        "transport": transport, "clients": clients, "n": plans,
        "plans_per_second": plans as f64 / duration.as_secs_f64(),
        "p50_ms": 1e3 * quantile(&latencies, 0.5), "p99_ms": 1e3 * quantile(&latencies, 0.99),
        "server_ms_p50": 1e3 * quantile(&server, 0.5),
    })
}

/// Quantile of sorted values; NaN if there are none.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    sorted.get((share * sorted.len() as f64) as usize).copied().unwrap_or(f64::NAN)
}
