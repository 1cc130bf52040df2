//! Contract of training runs of a real service, over each transport.

use crate::common::{NAME, episode, keep};
use futures::{Stream, StreamExt};
use prost::Message as _;
use service_kit::SessionConfig;
use std::future::Future;
use std::path::Path;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tempfile::TempDir;
use tonic::transport::Channel;
use trainer::runs::Runs;
use trainer::service::{self, Service};
use wire::proto::trainer_service_client::TrainerServiceClient;
use wire::training::{
    ListRunsResponse, Run, RunState, StartRunRequest, StartRunResponse, StopRunRequest, StopRunResponse,
    WatchRunResponse,
};
use wire::{Code, Error, Message, key, proto, query};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;

/// Timeout that no passing test reaches.
const PATIENCE: Duration = Duration::from_secs(120);
/// Settings of a short run.
const SHORT: &str = "preset = \"paper-bc\"\nthreads = 1\ntraining.batch_size = 4\ntraining.epochs = 2\n";
/// Settings of a run too long to finish before it is stopped.
const LONG: &str = "preset = \"paper-bc\"\nthreads = 1\ntraining.batch_size = 4\ntraining.epochs = 100000\n";

/// Running service, with a second zenoh session and a gRPC channel to it.
struct Fixture {
    service: Service,
    session: Session,
    channel: Channel,
}

/// Folder with demonstrations.
fn folder() -> TempDir {
    let folder = TempDir::new().unwrap();
    for (task, seed, steps) in [("reach", 1, 9), ("reach", 2, 7), ("door-lock", 1, 8)] {
        keep(&folder.path().join("data"), &episode(task, seed, steps));
    }
    folder
}

impl Fixture {
    async fn start(folder: &Path) -> Self {
        static NAMESPACES: AtomicU64 = AtomicU64::new(0);
        let number = NAMESPACES.fetch_add(1, Ordering::Relaxed);
        let namespace = Some(format!("test-{}-{number}", std::process::id()));
        let ours = SessionConfig { namespace: namespace.clone(), ..SessionConfig::default() };
        let session = service_kit::session::open(&ours).await.unwrap();
        let connect = session.info().locators().await.iter().map(ToString::to_string).collect();

        let service = service::start(service::Config {
            name: NAME.into(),
            dataset: folder.join("data"),
            checkpoints: folder.join("checkpoints"),
            runs: folder.join("runs"),
            grpc_listen: "127.0.0.1:0".parse().unwrap(),
            program: env!("CARGO_BIN_EXE_cpn-trainer").into(),
            session: SessionConfig { namespace, connect, ..SessionConfig::default() },
            ..service::Config::default()
        })
        .await
        .unwrap();

        let fixture = Self {
            channel: Channel::from_shared(format!("http://{}", service.grpc_address()))
                .unwrap()
                .connect()
                .await
                .unwrap(),
            session,
            service,
        };
        // Declarations arrive with a delay.
        trainer::runs::client::list(&fixture.session, NAME).await.unwrap();
        fixture
    }

    fn clients(&self) -> [Client; 3] {
        [
            Client::InProcess(self.service.runs()),
            Client::Grpc(TrainerServiceClient::new(self.channel.clone())),
            Client::Zenoh(self.session.clone()),
        ]
    }
}

/// Client of one transport. Requests are protobuf messages, so that invalid ones can be sent.
#[derive(Clone)]
enum Client {
    InProcess(Runs),
    Grpc(TrainerServiceClient<Channel>),
    Zenoh(Session),
}

impl Client {
    fn transport(&self) -> &'static str {
        match self {
            Self::InProcess(_) => "in-process",
            Self::Grpc(_) => "grpc",
            Self::Zenoh(_) => "zenoh",
        }
    }

    async fn start(&self, request: proto::StartRunRequest) -> Result<Run, Error> {
        match self {
            Self::InProcess(runs) => runs.start(&StartRunRequest::try_from(request)?),
            Self::Grpc(grpc) => {
                Ok(StartRunResponse::try_from(grpc.clone().start_run(request).await?.into_inner())?.run)
            }
            Self::Zenoh(session) => {
                let key = key::trainer_start_run(NAME)?;
                Ok(raw_query::<StartRunResponse>(session, &key, request.encode_to_vec()).await?.run)
            }
        }
    }

    async fn stop(&self, name: &str) -> Result<Run, Error> {
        let request = proto::StopRunRequest { name: name.into() };
        match self {
            Self::InProcess(runs) => runs.stop(&StopRunRequest::try_from(request)?.name).await,
            Self::Grpc(grpc) => Ok(StopRunResponse::try_from(grpc.clone().stop_run(request).await?.into_inner())?.run),
            Self::Zenoh(session) => {
                let key = key::trainer_stop_run(NAME)?;
                Ok(raw_query::<StopRunResponse>(session, &key, request.encode_to_vec()).await?.run)
            }
        }
    }

    async fn list(&self) -> Result<Vec<Run>, Error> {
        let request = proto::ListRunsRequest {};
        match self {
            Self::InProcess(runs) => Ok(runs.list()),
            Self::Grpc(grpc) => {
                Ok(ListRunsResponse::try_from(grpc.clone().list_runs(request).await?.into_inner())?.runs)
            }
            Self::Zenoh(session) => {
                let key = key::trainer_list_runs(NAME)?;
                Ok(raw_query::<ListRunsResponse>(session, &key, request.encode_to_vec()).await?.runs)
            }
        }
    }

    /// Stream of a run's states.
    async fn watch(&self, name: &str) -> Result<Pin<Box<dyn Stream<Item = Run> + Send>>, Error> {
        let request = proto::WatchRunRequest { name: name.into() };
        match self {
            Self::InProcess(runs) => Ok(runs.watch(name)?.boxed()),
            Self::Grpc(grpc) => {
                let runs = grpc.clone().watch_run(request).await?.into_inner();
                Ok(runs.map(|run| WatchRunResponse::try_from(run.unwrap()).unwrap().run).boxed())
            }
            Self::Zenoh(session) => {
                let published = session.declare_subscriber(key::training_progress(name)?).await.unwrap();
                let unknown = || Error::new(Code::NotFound, "name", "the name of a run", format!("{name:?}"));
                let now = self.list().await?.into_iter().find(|run| run.name == name).ok_or_else(unknown)?;
                let state = Some((published, Some(now)));
                Ok(futures::stream::unfold(state, |state| async {
                    let (published, now) = state?;
                    let run: Run = match now {
                        Some(run) => run,
                        None => {
                            let sample = published.recv_async().await.unwrap();
                            assert_eq!(*sample.encoding(), query::encoding::<proto::Run>());
                            wire::decode(&sample.payload().to_bytes()).unwrap()
                        }
                    };
                    let next = (run.state == RunState::Running).then_some((published, None));
                    Some((run, next))
                })
                .boxed())
            }
        }
    }

    /// States of a run until it ends.
    async fn to_the_end(&self, name: &str) -> Vec<Run> {
        soon(self.watch(name).await.unwrap().collect()).await
    }

    /// Waits for the first step of a run.
    async fn first_step(&self, name: &str) -> Run {
        let mut runs = self.watch(name).await.unwrap();
        loop {
            let run = soon(runs.next()).await.unwrap();
            assert_eq!(run.state, RunState::Running, "{run:?}");
            if run.progress.is_some_and(|progress| progress.step > 0) {
                return run;
            }
        }
    }
}

/// Sends a query with any bytes as its payload.
async fn raw_query<R: Message>(session: &Session, key: &OwnedKeyExpr, payload: Vec<u8>) -> Result<R, Error> {
    let replies = session.get(key).timeout(PATIENCE).payload(payload).await.unwrap();
    match replies.recv_async().await.unwrap().into_result() {
        Ok(sample) => wire::decode(&sample.payload().to_bytes()),
        Err(error) => {
            assert_eq!(*error.encoding(), query::encoding::<proto::Error>(), "zenoh's own error");
            Err(proto::Error::decode(&*error.payload().to_bytes()).unwrap().into())
        }
    }
}

/// Awaits with a timeout, so that a test fails instead of hanging.
async fn soon<F: Future>(future: F) -> F::Output {
    tokio::time::timeout(PATIENCE, future).await.expect("nothing happened for two minutes")
}

fn request(name: &str, settings: &str) -> proto::StartRunRequest {
    proto::StartRunRequest {
        name: name.into(),
        hold_out: vec!["door-lock".into()],
        seed: Some(3),
        settings: settings.into(),
        ..proto::StartRunRequest::default()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_transport_starts_and_watches_runs() {
    let folder = folder();
    let fixture = Fixture::start(folder.path()).await;
    let mut digests = Vec::new();
    for client in fixture.clients() {
        let name = client.transport();
        let started = client.start(request(name, SHORT)).await.unwrap();
        assert_eq!(started, Run { name: name.into(), state: RunState::Running, progress: None }, "{name}");

        let heard = client.to_the_end(name).await;
        let (last, before) = heard.split_last().unwrap();
        assert!(before.iter().all(|run| run.state == RunState::Running), "{name}: {before:?}");
        let steps: Vec<_> = heard.iter().filter_map(|run| Some(run.progress?.step)).collect();
        assert!(steps.is_sorted(), "{name}: {steps:?}");
        // Two epochs of 14 samples in batches of 4.
        let progress = last.progress.unwrap();
        assert_eq!((progress.step, progress.steps, progress.epoch, progress.samples), (8, 8, 2, 28), "{name}");

        let RunState::Finished { digest } = &last.state else { panic!("{name}: {last:?}") };
        digests.push(digest.clone());
        assert_eq!(client.list().await.unwrap().iter().find(|run| run.name == name), Some(last));
        let checkpoint = std::fs::read(folder.path().join(format!("checkpoints/{name}.safetensors"))).unwrap();
        assert_eq!(cpn::checkpoint::digest(&checkpoint), *digest);
        assert!(folder.path().join(format!("runs/{name}/curve.svg")).exists());
    }
    assert!(digests.iter().all(|digest| *digest == digests[0]), "the same settings, the same weights: {digests:?}");
    fixture.service.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn every_transport_stops_and_resumes_runs() {
    let folder = folder();
    let fixture = Fixture::start(folder.path()).await;
    for client in fixture.clients() {
        let name = client.transport();
        client.start(request(name, LONG)).await.unwrap();
        client.first_step(name).await;
        let one_more = client.start(request("one-more", SHORT)).await.unwrap_err();
        assert_eq!((one_more.code, one_more.field.as_str()), (Code::ResourceExhausted, "max_runs"), "{name}");
        let twice = client.start(request(name, LONG)).await.unwrap_err();
        assert_eq!((twice.code, twice.field.as_str()), (Code::FailedPrecondition, "name"), "{name}");

        let stopped = client.stop(name).await.unwrap();
        assert_eq!(stopped.state, RunState::Stopped, "{name}");
        assert_eq!(client.to_the_end(name).await.as_slice(), std::slice::from_ref(&stopped), "{name}");
        let again = client.stop(name).await.unwrap_err();
        assert_eq!((again.code, again.field.as_str()), (Code::FailedPrecondition, "name"), "{name}");

        let other = client.start(request(name, SHORT)).await.unwrap_err();
        assert_eq!((other.code, other.field.as_str()), (Code::FailedPrecondition, "settings"), "{name}");
        client.start(proto::StartRunRequest { name: name.into(), ..Default::default() }).await.unwrap();
        let step = stopped.progress.unwrap().step;
        let mut runs = client.watch(name).await.unwrap();
        while soon(runs.next()).await.unwrap().progress.unwrap().step <= step {}
        assert_eq!(client.stop(name).await.unwrap().state, RunState::Stopped, "{name}");
    }
    fixture.service.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn every_transport_refuses_the_same_requests() {
    let folder = folder();
    let fixture = Fixture::start(folder.path()).await;

    let with = |settings: &str| request("wrong", settings);
    let cases = [
        (request("Wrong", SHORT), "name"),
        (request("../wrong", SHORT), "name"),
        (with("training.epochs ="), "settings"),
        (with("training.epoch = 3"), "settings"),
        (with("training.epochs = \"three\""), "settings"),
        (with(&format!("# {}", "x".repeat(20_000))), "settings"),
        (with("out = \"/tmp/x\""), "settings.out"),
        (with("dataset = \"/tmp/x\""), "settings.dataset"),
        (with("run_dir = \"/tmp/x\""), "settings.run_dir"),
        (with("seed = 4"), "settings.seed"),
        (proto::StartRunRequest { seed: Some(u64::MAX), ..with(SHORT) }, "seed"),
        (proto::StartRunRequest { hold_out: vec!["Door".into()], ..with(SHORT) }, "hold_out"),
    ];

    for (request, field) in cases {
        let mut errors = Vec::new();
        for client in fixture.clients() {
            let error = client.start(request.clone()).await.unwrap_err();
            assert_eq!((error.code, error.field.as_str()), (Code::InvalidArgument, field), "{}", client.transport());
            errors.push(error);
        }
        assert!(errors.iter().all(|error| *error == errors[0]), "{errors:?}");
    }

    let unknown = Error::new(Code::NotFound, "name", "the name of a run", "\"nobody\"");
    for client in fixture.clients() {
        assert_eq!(client.stop("nobody").await.unwrap_err(), unknown);
        assert_eq!(client.watch("nobody").await.err().unwrap(), unknown);
        assert_eq!(client.list().await.unwrap(), []);
    }
    fixture.service.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_failed_run_has_its_reason() {
    let folder = folder();
    let fixture = Fixture::start(folder.path()).await;
    let [client, ..] = fixture.clients();
    client.start(proto::StartRunRequest { hold_out: vec!["door-lokc".into()], ..request("run", SHORT) }).await.unwrap();
    let heard = client.to_the_end("run").await;
    let RunState::Failed { reason } = &heard.last().unwrap().state else { panic!("{heard:?}") };
    assert!(reason.contains("hold_out: expected some of [\"door-lock\", \"reach\"], got \"door-lokc\""), "{reason}");
    fixture.service.shutdown().await.unwrap();
}

/// A run's state and progress outlast the service.
#[tokio::test(flavor = "multi_thread")]
async fn a_run_outlasts_the_service() {
    let folder = folder();
    let settings = SHORT.replace("epochs = 2", "epochs = 100");
    let fixture = Fixture::start(folder.path()).await;
    let [client, ..] = fixture.clients();
    client.start(request("run", &settings)).await.unwrap();
    let reached = client.first_step("run").await.progress.unwrap().step;
    fixture.service.shutdown().await.unwrap();

    let fixture = Fixture::start(folder.path()).await;
    let [client, ..] = fixture.clients();
    let [run] = &client.list().await.unwrap()[..] else { panic!("one run") };
    assert_eq!(run.state, RunState::Interrupted);
    let step = run.progress.unwrap().step;
    assert!((reached..400).contains(&step), "{step}");
    client.start(request("run", &settings)).await.unwrap();
    client.to_the_end("run").await;
    let noted = trainer::training::journal::read(&folder.path().join("runs/run")).unwrap();
    let steps: Vec<_> = noted.iter().map(|entry| entry.progress.step).collect();
    assert_eq!(steps, (1..=400).collect::<Vec<_>>());
    fixture.service.shutdown().await.unwrap();
}

/// The registry follows the folders of runs: a removed one can be started anew.
#[tokio::test(flavor = "multi_thread")]
async fn a_run_whose_folder_was_removed_is_started_anew() {
    let folder = folder();
    let fixture = Fixture::start(folder.path()).await;
    for client in fixture.clients() {
        client.start(request("run", SHORT)).await.unwrap();
        client.to_the_end("run").await;
        let again = client.start(request("run", SHORT)).await.unwrap_err();
        assert_eq!((again.code, again.field.as_str()), (Code::FailedPrecondition, "name"), "{}", client.transport());
        std::fs::remove_dir_all(folder.path().join("runs/run")).unwrap();
        assert_eq!(client.list().await.unwrap(), [], "{}", client.transport());
    }

    // Files of others in the folder are not runs, damaged or not.
    std::fs::create_dir(folder.path().join("runs/.Trash-1000")).unwrap();
    let config = trainer::runs::Config {
        folder: folder.path().join("runs"),
        dataset: folder.path().join("data"),
        checkpoints: folder.path().join("checkpoints"),
        max_runs: 1,
        program: env!("CARGO_BIN_EXE_cpn-trainer").into(),
    };
    let error = format!("{:#}", Runs::open(config.clone()).unwrap_err());
    assert!(error.contains("expected one that no process keeps, got that of process "), "{error}");
    fixture.service.shutdown().await.unwrap();
    assert_eq!(Runs::open(config).unwrap().list(), []);
}
