//! Fixtures: a planner on loopback, and a client of each of its transports.

use cpn::checkpoint::{self, Provenance};
use cpn::method::{Iterations, Observed, Query, Search, Solver};
use cpn::{EncoderConfig, Input, Method, MethodKind, ModelConfig, Plan, Random};
use planner::core::PlannerCore;
use planner::model::Model;
use planner::{Config, Planner};
use prost::Message as _;
use service_kit::SessionConfig;
use std::future::Future;
use std::net::SocketAddr;
use std::process::Command;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc;
use std::time::Duration;
use tempfile::TempDir;
pub use testing::process::PATIENCE;
use testing::process::{Log, Process, free_address};
use testing::{provenance, small_config};
use tonic::transport::Channel;
use wire::planner::{
    ListModelsResponse, LoadModelRequest, LoadModelResponse, ModelInfo, PlanRequest, PlanResponse, RegisterGoalRequest,
    RegisterGoalResponse, StageTimes, UnloadModelRequest, UnloadModelResponse,
};
use wire::proto::planner_service_client::PlannerServiceClient;
use wire::{Code, Error, Message, key, proto, query};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;

/// Name of every planner here; their namespaces differ.
pub const NAME: &str = "under-test";

/// Running planner, with a second zenoh session and a gRPC channel to it.
pub struct Fixture {
    pub planner: Planner,
    pub session: Session,
    pub channel: Channel,
    pub models_dir: TempDir,
    pub namespace: Option<String>,
}

impl Fixture {
    /// Starts a planner with `checkpoints`, by name, and `configure`'s changes to the settings.
    pub async fn start(checkpoints: &[(&str, Vec<u8>)], configure: impl FnOnce(&mut Config)) -> Self {
        let models_dir = models(checkpoints);
        static NAMESPACES: AtomicU64 = AtomicU64::new(0);
        let number = NAMESPACES.fetch_add(1, Ordering::Relaxed);
        let namespace = Some(format!("test-{}-{number}", std::process::id()));
        let ours = SessionConfig { namespace: namespace.clone(), ..SessionConfig::default() };
        let session = service_kit::session::open(&ours).await.unwrap();
        let planners =
            session.liveliness().declare_subscriber(key::planner_alive("*").unwrap()).history(true).await.unwrap();
        let connect = session.info().locators().await.iter().map(ToString::to_string).collect();
        let mut config = Config {
            name: NAME.into(),
            models_dir: models_dir.path().into(),
            grpc_listen: ([127, 0, 0, 1], 0).into(),
            session: SessionConfig { namespace: namespace.clone(), connect, ..SessionConfig::default() },
            ..Config::default()
        };
        configure(&mut config);
        let planner = planner::start(config).await.unwrap();
        soon(planners.recv_async()).await.unwrap();
        let url = format!("http://{}", planner.grpc_address());
        let channel = Channel::from_shared(url).unwrap().connect().await.unwrap();
        Self { planner, session, channel, models_dir, namespace }
    }

    /// One client of each transport.
    pub fn clients(&self) -> [Client; 3] {
        [
            Client::InProcess(self.planner.core()),
            Client::Grpc(PlannerServiceClient::new(self.channel.clone())),
            Client::Zenoh(self.session.clone()),
        ]
    }
}

/// Planner in a process of its own, with a session and a channel to it.
pub struct Program {
    pub process: Process,
    pub log: Log,
    pub session: Session,
    pub channel: Channel,
    pub models_dir: TempDir,
    /// Endpoint of zenoh.
    pub endpoint: String,
    pub grpc: SocketAddr,
    pub metrics: SocketAddr,
}

impl Program {
    /// Starts a planner with `checkpoints`, by name, and `configure`'s options.
    pub async fn start(checkpoints: &[(&str, Vec<u8>)], configure: impl FnOnce(&mut Command)) -> Self {
        let models_dir = models(checkpoints);
        let (endpoint, grpc, metrics) = (format!("tcp/{}", free_address()), free_address(), free_address());
        let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-planner"));
        command.args(["--name", NAME, "--listen", &endpoint, "--grpc-listen", &grpc.to_string()]);
        command.args(["--metrics-listen", &metrics.to_string(), "--models-dir"]).arg(models_dir.path());
        configure(command.env_remove("RUST_LOG"));
        let (process, log) = Process::logged(&mut command);
        let session = connected(&endpoint).await;
        let channel = Channel::from_shared(format!("http://{grpc}")).unwrap().connect().await.unwrap();
        Self { process, log, session, channel, models_dir, endpoint, grpc, metrics }
    }

    /// One client of each transport.
    pub fn clients(&self) -> [Client; 2] {
        [Client::Grpc(PlannerServiceClient::new(self.channel.clone())), Client::Zenoh(self.session.clone())]
    }
}

/// Session with the planner that listens on an endpoint.
pub async fn connected(endpoint: &str) -> Session {
    let config = SessionConfig { connect: vec![endpoint.into()], ..SessionConfig::default() };
    let session = service_kit::session::open(&config).await.unwrap();
    let alive = session.liveliness().declare_subscriber(key::planner_alive(NAME).unwrap()).history(true);
    soon(alive.await.unwrap().recv_async()).await.unwrap();
    session
}

/// Folder of checkpoints, by name.
fn models(checkpoints: &[(&str, Vec<u8>)]) -> TempDir {
    let folder = TempDir::new().unwrap();
    for (name, bytes) in checkpoints {
        std::fs::write(folder.path().join(format!("{name}.safetensors")), bytes).unwrap();
    }
    folder
}

/// Client of one transport. Requests are protobuf messages, so that invalid ones can be sent.
#[derive(Clone)]
pub enum Client {
    InProcess(PlannerCore),
    Grpc(PlannerServiceClient<Channel>),
    Zenoh(Session),
}

impl Client {
    pub fn transport(&self) -> &'static str {
        match self {
            Self::InProcess(_) => "in-process",
            Self::Grpc(_) => "gRPC",
            Self::Zenoh(_) => "zenoh",
        }
    }

    pub async fn plan(&self, request: proto::PlanRequest) -> Result<PlanResponse, Error> {
        match self {
            Self::InProcess(core) => core.plan(PlanRequest::try_from(request)?).await,
            Self::Grpc(grpc) => grpc.clone().plan(request).await?.into_inner().try_into(),
            Self::Zenoh(session) => raw_query(session, &key::planner_plan(NAME)?, encoded(&request)).await,
        }
    }

    pub async fn register_goal(&self, request: proto::RegisterGoalRequest) -> Result<RegisterGoalResponse, Error> {
        match self {
            Self::InProcess(core) => core.register_goal(RegisterGoalRequest::try_from(request)?),
            Self::Grpc(grpc) => grpc.clone().register_goal(request).await?.into_inner().try_into(),
            Self::Zenoh(session) => raw_query(session, &key::planner_register_goal(NAME)?, encoded(&request)).await,
        }
    }

    pub async fn load_model(&self, request: proto::LoadModelRequest) -> Result<LoadModelResponse, Error> {
        match self {
            Self::InProcess(core) => core.load_model(LoadModelRequest::try_from(request)?).await,
            Self::Grpc(grpc) => grpc.clone().load_model(request).await?.into_inner().try_into(),
            Self::Zenoh(session) => raw_query(session, &key::planner_load_model(NAME)?, encoded(&request)).await,
        }
    }

    pub async fn unload_model(&self, model: &str) -> Result<UnloadModelResponse, Error> {
        let request = proto::UnloadModelRequest { model: model.into() };
        match self {
            Self::InProcess(core) => core.unload_model(UnloadModelRequest::try_from(request)?).await,
            Self::Grpc(grpc) => grpc.clone().unload_model(request).await?.into_inner().try_into(),
            Self::Zenoh(session) => raw_query(session, &key::planner_unload_model(NAME)?, encoded(&request)).await,
        }
    }

    pub async fn list_models(&self) -> Result<ListModelsResponse, Error> {
        let request = proto::ListModelsRequest {};
        match self {
            Self::InProcess(core) => Ok(core.list_models()),
            Self::Grpc(grpc) => grpc.clone().list_models(request).await?.into_inner().try_into(),
            Self::Zenoh(session) => raw_query(session, &key::planner_list_models(NAME)?, encoded(&request)).await,
        }
    }

    /// Digest of the checkpoint that answers a plan by this model.
    pub async fn digest(&self, model: &str) -> String {
        self.plan(plan_request(model, 1)).await.unwrap().model_digest
    }
}

fn encoded(request: &impl prost::Message) -> Option<Vec<u8>> {
    Some(request.encode_to_vec())
}

/// Sends a query with any bytes as its payload, or without.
pub async fn raw_query<R: Message>(
    session: &Session,
    key: &OwnedKeyExpr,
    payload: Option<Vec<u8>>,
) -> Result<R, Error> {
    let get = session.get(key).timeout(PATIENCE);
    let replies = match payload {
        Some(bytes) => get.payload(bytes).await,
        None => get.await,
    };
    match replies.unwrap().recv_async().await.unwrap().into_result() {
        Ok(sample) => wire::decode(&sample.payload().to_bytes()),
        Err(error) => {
            assert_eq!(*error.encoding(), query::encoding::<proto::Error>(), "zenoh's own error");
            Err(proto::Error::decode(&*error.payload().to_bytes()).unwrap().into())
        }
    }
}

/// Awaits with a timeout, so that a test fails instead of hanging.
pub async fn soon<F: Future>(future: F) -> F::Output {
    tokio::time::timeout(PATIENCE, future).await.expect("nothing happened for a minute")
}

/// Random image of a seed.
pub fn image(seed: u64) -> proto::Image {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let data = (0..cpn::images::BYTES).map(|_| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state as u8
    });
    let format = proto::PixelFormat::Rgb8.into();
    proto::Image { height: 84, width: 84, format, data: data.collect(), render_spec: String::new() }
}

/// Plan request from the image of `seed` to that of 0, with 40 steps left.
pub fn plan_request(model: &str, seed: u64) -> proto::PlanRequest {
    proto::PlanRequest {
        model: model.into(),
        goal: Some(proto::plan_request::Goal::GoalImage(image(0))),
        observed: Some(proto::plan_request::Observed::Observation(image(seed))),
        seed,
        steps_left: Some(40),
        ..Default::default()
    }
}

/// Response without its times, for comparisons.
pub fn timeless(response: PlanResponse) -> PlanResponse {
    PlanResponse { times: StageTimes::default(), ..response }
}

pub fn from_bytes(model: &str, checkpoint: Vec<u8>) -> proto::LoadModelRequest {
    proto::LoadModelRequest {
        model: model.into(),
        source: Some(proto::load_model_request::Source::Checkpoint(checkpoint)),
    }
}

pub fn from_file(model: &str, file: &str) -> proto::LoadModelRequest {
    proto::LoadModelRequest { model: model.into(), source: Some(proto::load_model_request::Source::File(file.into())) }
}

/// Checkpoint of a small, random model without a render spec.
pub fn checkpoint(method: MethodKind, seed: u64) -> Vec<u8> {
    checkpoint_for(method, seed, "")
}

/// Checkpoint of a small, random model with a render spec.
pub fn checkpoint_for(method: MethodKind, seed: u64, render_spec: &str) -> Vec<u8> {
    let provenance = Provenance { render_spec: render_spec.into(), ..provenance(&["door-lock", "reach"], seed) };
    checkpoint::to_bytes(&cpn::Model::new(small_config(method), seed), &provenance).unwrap()
}

/// Checkpoint of a small, random model of positions.
pub fn position_checkpoint(seed: u64) -> Vec<u8> {
    let encoder = EncoderConfig::position([600, 0, 200], 100);
    let config = ModelConfig { encoder, hidden: 5, gate_hidden: 4, actions: 3, ..ModelConfig::paper(MethodKind::Cpn) };
    checkpoint::to_bytes(&cpn::Model::new(config, seed), &provenance(&["jenga-poke"], seed)).unwrap()
}

/// Plan request from one position to another.
pub fn position_request(model: &str) -> proto::PlanRequest {
    let (hand, goal) = (proto::Position { x: 0.5, y: 0.1, z: 0.2 }, proto::Position { x: 0.73, y: -0.09, z: 0.18 });
    proto::PlanRequest {
        model: model.into(),
        goal: Some(proto::plan_request::Goal::GoalPosition(goal)),
        observed: Some(proto::plan_request::Observed::Position(hand)),
        seed: 0,
        ..Default::default()
    }
}

/// Method with the plans of a closure.
pub fn method(plan: impl FnMut(&[Query<'_>]) -> Vec<Plan> + Send + 'static) -> Box<dyn Method> {
    Box::new(Stub(plan))
}

/// Plans of [`Random`].
pub fn random(queries: &[Query<'_>]) -> Vec<Plan> {
    Random { actions: 4 }.plan(queries, &mut Search { solver: Solver::Gradient, iterations: Iterations::Fixed(0) })
}

struct Stub<F>(F);

impl<F: FnMut(&[Query<'_>]) -> Vec<Plan> + Send> Method for Stub<F> {
    fn name(&self) -> &'static str {
        "random"
    }

    fn horizon(&self) -> usize {
        1
    }

    fn actions(&self) -> usize {
        4
    }

    fn updates(&self) -> Option<usize> {
        None
    }

    fn takes(&self, _: Input) -> bool {
        true
    }

    fn encode(&mut self, inputs: &[Observed<'_>]) -> Vec<Vec<f32>> {
        Random { actions: 4 }.encode(inputs)
    }

    fn plan(&mut self, queries: &[Query<'_>], _: &mut Search<'_>) -> Vec<Plan> {
        (self.0)(queries)
    }
}

/// Control of a gated method, which reports the seed of a plan and then waits to be released.
pub struct Gate {
    entered: mpsc::Receiver<u64>,
    gate: mpsc::Sender<()>,
}

impl Gate {
    /// Serves a gated method under the name `gated`.
    pub async fn serve(core: &PlannerCore) -> Self {
        let (sender, entered) = mpsc::channel();
        let (gate, receiver) = mpsc::channel();
        let gated = method(move |queries| {
            for query in queries {
                sender.send(query.seed).unwrap();
                receiver.recv_timeout(PATIENCE).unwrap();
            }
            random(queries)
        });
        serve(core, "gated", gated).await;
        Self { entered, gate }
    }

    /// Waits until a plan has begun; returns its seed.
    pub async fn entered(&self) -> u64 {
        let arrival = async {
            loop {
                match self.entered.try_recv() {
                    Ok(seed) => return seed,
                    Err(_) => tokio::time::sleep(Duration::from_millis(1)).await,
                }
            }
        };
        soon(arrival).await
    }

    /// Releases one plan.
    pub fn open(&self) {
        self.gate.send(()).unwrap();
    }
}

/// Faulty method: on even seeds its actions are NaN, on odd ones it panics.
pub fn faulty() -> Box<dyn Method> {
    let plan = |query: &Query<'_>| {
        assert!(query.seed.is_multiple_of(2), "an odd seed");
        Plan { actions: vec![vec![f32::NAN; 4]], inner_losses: Vec::new(), iterations: 0 }
    };
    method(move |queries| queries.iter().map(plan).collect())
}

pub async fn serve(core: &PlannerCore, name: &str, method: Box<dyn Method>) {
    let info = ModelInfo {
        name: name.into(),
        method: method.name().into(),
        digest: checkpoint::digest(name.as_bytes()),
        training_tasks: Vec::new(),
        horizon: 1,
        version: 0,
    };
    core.serve(Model::new(info, String::new(), method)).await.unwrap();
}

pub fn is(code: Code, field: &str, result: Result<PlanResponse, Error>) {
    let error = result.unwrap_err();
    assert_eq!((error.code, error.field.as_str()), (code, field), "{error}");
}
