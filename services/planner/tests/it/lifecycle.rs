//! Start, health, reflection, drain.

use crate::common::{self, Fixture, Gate, checkpoint, is, plan_request, soon};
use cpn::MethodKind;
use planner::Config;
use planner::model::RANDOM;
use tempfile::TempDir;
use tonic::codegen::tokio_stream;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_reflection::pb::v1::ServerReflectionRequest;
use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;
use wire::{Code, key};
use zenoh::sample::SampleKind;

#[tokio::test(flavor = "multi_thread")]
async fn a_ready_planner_is_healthy_and_describes_itself() {
    let fixture = Fixture::start(&[], |_| ()).await;
    for service in ["", "cpn.v1.PlannerService"] {
        let request = HealthCheckRequest { service: service.into() };
        let health = HealthClient::new(fixture.channel.clone()).check(request).await.unwrap().into_inner();
        assert_eq!(health.status(), ServingStatus::Serving, "{service:?}");
    }
    let message_request = Some(MessageRequest::ListServices(String::new()));
    let request = ServerReflectionRequest { host: String::new(), message_request };
    let mut reflection = ServerReflectionClient::new(fixture.channel.clone());
    let mut answers = reflection.server_reflection_info(tokio_stream::once(request)).await.unwrap().into_inner();
    let Some(MessageResponse::ListServicesResponse(list)) = answers.message().await.unwrap().unwrap().message_response
    else {
        panic!("expected a list of services");
    };
    let names: Vec<_> = list.service.into_iter().map(|service| service.name).collect();
    for name in ["cpn.v1.PlannerService", "grpc.health.v1.Health", "inference.GRPCInferenceService"] {
        assert!(names.iter().any(|n| n == name), "{names:?}");
    }
}

/// A plan in progress at shutdown is finished and answered, on every transport.
#[tokio::test(flavor = "multi_thread")]
async fn shutdown_lets_a_plan_finish() {
    for transport in 0..3 {
        let fixture = Fixture::start(&[], |_| ()).await;
        let core = fixture.planner.core();
        let gate = Gate::serve(&core).await;
        let client = fixture.clients()[transport].clone();
        let name = client.transport();
        let token = key::planner_alive(common::NAME).unwrap();
        let alive = fixture.session.liveliness().declare_subscriber(token).await.unwrap();
        let plan = tokio::spawn(async move { client.plan(plan_request("gated", 1)).await });
        assert_eq!(gate.entered().await, 1);
        let shutdown = tokio::spawn(fixture.planner.shutdown());
        let gone = soon(alive.recv_async()).await.unwrap();
        assert_eq!(gone.kind(), SampleKind::Delete);
        gate.open();
        soon(plan).await.unwrap().unwrap_or_else(|error| panic!("{name}: {error}"));
        soon(shutdown).await.unwrap().unwrap();
        let request = wire::planner::PlanRequest::try_from(plan_request(RANDOM, 2)).unwrap();
        is(Code::Unavailable, "planner", core.plan(request).await);
    }
}

/// A health watcher sees the change, and its open stream does not delay shutdown.
#[tokio::test(flavor = "multi_thread")]
async fn shutdown_is_reported_to_health_watchers() {
    let fixture = Fixture::start(&[], |_| ()).await;
    let request = HealthCheckRequest { service: "cpn.v1.PlannerService".into() };
    let mut health = HealthClient::new(fixture.channel.clone()).watch(request).await.unwrap().into_inner();
    assert_eq!(health.message().await.unwrap().unwrap().status(), ServingStatus::Serving);
    fixture.planner.shutdown().await.unwrap();
    assert_eq!(health.message().await.unwrap().unwrap().status(), ServingStatus::NotServing);
    assert_eq!(health.message().await.unwrap(), None);
}

fn config(models_dir: &TempDir) -> Config {
    Config { models_dir: models_dir.path().into(), grpc_listen: ([127, 0, 0, 1], 0).into(), ..Config::default() }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_faulty_checkpoint_prevents_the_start() {
    for (file, bytes, reason) in [
        ("damaged.safetensors", vec![1, 2, 3], "checkpoint: expected one that can be loaded"),
        ("Capital.safetensors", checkpoint(MethodKind::Bc, 1), "file: expected 1 to 64 of a-z"),
        ("random.safetensors", checkpoint(MethodKind::Bc, 1), "model: expected a name other than random"),
    ] {
        let models_dir = TempDir::new().unwrap();
        std::fs::write(models_dir.path().join(file), bytes).unwrap();
        let error = format!("{:#}", planner::start(config(&models_dir)).await.unwrap_err());
        assert!(error.contains(file) && error.contains(reason), "{error}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn without_checkpoints_the_random_model_is_served() {
    let models_dir = TempDir::new().unwrap();
    let planner = planner::start(config(&models_dir)).await.unwrap();
    let models = planner.core().list_models().models;
    assert_eq!(models.iter().map(|info| info.name.as_str()).collect::<Vec<_>>(), [RANDOM]);
    planner.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_configured_folder_must_exist_and_hidden_files_are_ignored() {
    let models_dir = TempDir::new().unwrap();
    let absent = Config { models_dir: models_dir.path().join("absent"), ..config(&models_dir) };
    let error = format!("{:#}", planner::start(absent).await.unwrap_err());
    assert!(error.contains("models_dir: folder ") && error.contains("absent"), "{error}");

    for stray in ["._cpn.safetensors", ".cpn.safetensors.lock"] {
        std::fs::write(models_dir.path().join(stray), "no checkpoint").unwrap();
    }
    std::fs::create_dir(models_dir.path().join("lost+found")).unwrap();
    let planner = planner::start(config(&models_dir)).await.unwrap();
    assert_eq!(planner.core().list_models().models.len(), 1);
    planner.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_name_that_selects_many_planners_is_refused() {
    let models_dir = TempDir::new().unwrap();
    for name in ["*", "a/b"] {
        let error = planner::start(Config { name: name.into(), ..config(&models_dir) }).await.unwrap_err();
        assert!(format!("{error:#}").contains(name), "{error:#}");
    }
}
