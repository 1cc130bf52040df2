//! Planner as a client of a router that starts late, stops, and restarts.

use crate::common::{self, soon};
use planner::Config;
use service_kit::SessionConfig;
use service_kit::session::Mode;
use std::net::SocketAddr;
use std::time::Duration;
use testing::process::free_address;
use tonic::transport::Channel;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use wire::planner::{ListModelsRequest, ListModelsResponse};
use wire::{Code, key, query};
use zenoh::Session;

const TIMEOUT: Duration = Duration::from_secs(2);

async fn router(endpoint: &str) -> Session {
    let config = SessionConfig { mode: Some(Mode::Router), listen: vec![endpoint.into()], ..SessionConfig::default() };
    service_kit::session::open(&config).await.unwrap()
}

fn client(endpoint: &str) -> SessionConfig {
    SessionConfig { mode: Some(Mode::Client), connect: vec![endpoint.into()], ..SessionConfig::default() }
}

/// Waits until the health of a service is `expected`.
async fn healthy(address: SocketAddr, service: &str, expected: ServingStatus) {
    let channel = Channel::from_shared(format!("http://{address}")).unwrap().connect_lazy();
    let mut health = HealthClient::new(channel);
    soon(async {
        loop {
            let answer = health.check(HealthCheckRequest { service: service.into() }).await;
            if answer.is_ok_and(|answer| answer.into_inner().status() == expected) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn health_reports_the_router_and_the_planner_joins_a_late_one() {
    let endpoint = format!("tcp/{}", free_address());
    let (address, models) = (free_address(), tempfile::tempdir().unwrap());
    let config = Config {
        models_dir: models.path().into(),
        grpc_listen: address,
        session: client(&endpoint),
        ..Config::default()
    };
    let starting = tokio::spawn(planner::start(config));
    healthy(address, "", ServingStatus::NotServing).await;
    healthy(address, "zenoh", ServingStatus::NotServing).await;

    let first = router(&endpoint).await;
    let planner = soon(starting).await.unwrap().unwrap();
    healthy(address, "", ServingStatus::Serving).await;
    healthy(address, "zenoh", ServingStatus::Serving).await;
    let asking = service_kit::session::open(&client(&endpoint)).await.unwrap();
    let ask = async |name: &str| {
        let key = key::planner_list_models(name).unwrap();
        query::call::<_, ListModelsResponse>(&asking, &key, ListModelsRequest, TIMEOUT).await
    };
    ask("planner").await.unwrap();
    let nobody = ask("nobody").await.unwrap_err();
    assert_eq!((nobody.code, nobody.field.as_str()), (Code::Unavailable, "cpn/@v1/planner/nobody/list_models"));

    first.close().await.unwrap();
    healthy(address, "zenoh", ServingStatus::NotServing).await;
    healthy(address, "", ServingStatus::Serving).await;
    let no_router = ask("planner").await.unwrap_err();
    assert_eq!((no_router.code, no_router.field.as_str()), (Code::Unavailable, "session"));

    let _second = router(&endpoint).await;
    healthy(address, "zenoh", ServingStatus::Serving).await;
    soon(async {
        while ask("planner").await.is_err() {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    })
    .await;
    planner.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn all_planners_answer_a_wildcard_query_under_their_own_keys() {
    let endpoint = format!("tcp/{}", free_address());
    let _router = router(&endpoint).await;
    let models = tempfile::tempdir().unwrap();
    let mut planners = Vec::new();
    for name in ["p0", "p1"] {
        let config = Config {
            name: name.into(),
            models_dir: models.path().into(),
            grpc_listen: ([127, 0, 0, 1], 0).into(),
            session: client(&endpoint),
            ..Config::default()
        };
        planners.push(planner::start(config).await.unwrap());
    }
    let asking = service_kit::session::open(&client(&endpoint)).await.unwrap();
    let key = key::planner_list_models("*").unwrap();
    // As any client queries, with zenoh's default consolidation of answers.
    let replies = asking.get(&key).payload(wire::encode(ListModelsRequest)).timeout(TIMEOUT).await.unwrap();
    let mut keys = Vec::new();
    while let Ok(reply) = soon(replies.recv_async()).await {
        let sample = reply.into_result().unwrap();
        wire::decode::<ListModelsResponse>(&sample.payload().to_bytes()).unwrap();
        keys.push(sample.key_expr().to_string());
    }
    keys.sort();
    assert_eq!(keys, ["p0", "p1"].map(|name| key::planner_list_models(name).unwrap().to_string()));
}

#[tokio::test(flavor = "multi_thread")]
async fn zenohs_own_file_and_passwords_are_applied() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    let endpoint = format!("tcp/{}", free_address());
    let users = write("users.txt", "robot:secret\n");
    let file = format!(
        "{{ mode: 'router', listen: {{ endpoints: ['{endpoint}'] }}, scouting: {{ multicast: {{ enabled: false }} }},\
         transport: {{ auth: {{ usrpwd: {{ user: 'router', password: 'r', dictionary_file: '{}' }} }} }} }}",
        users.display()
    );
    let zenoh_config = Some(write("router.json5", &file));
    let _router =
        service_kit::session::open(&SessionConfig { zenoh_config, ..SessionConfig::default() }).await.unwrap();
    let joins = async |password: &str, within: Duration| {
        let password_file = Some(write("password", password));
        let config = SessionConfig { user: Some("robot".into()), password_file, ..client(&endpoint) };
        tokio::time::timeout(within, service_kit::session::open(&config)).await.is_ok()
    };
    assert!(joins("secret\n", common::PATIENCE).await);
    assert!(!joins("guessed", TIMEOUT).await);

    // Options win over the file; settings missing in the file are zenoh's defaults, which listen on all interfaces.
    let file = write("peer.json5", "{ scouting: { multicast: { enabled: false } } }");
    let config = SessionConfig { zenoh_config: Some(file), ..SessionConfig::default() };
    let error = service_kit::session::open(&config).await.unwrap_err().to_string();
    assert!(error.starts_with("listen: expected a tls/ endpoint beyond the loopback interface"), "{error}");
    let config = SessionConfig { listen: vec!["tcp/127.0.0.1:0".into()], ..config };
    service_kit::session::open(&config).await.unwrap();
    let config = SessionConfig { zenoh_config: Some(folder.path().join("none")), ..SessionConfig::default() };
    let error = service_kit::session::open(&config).await.unwrap_err().to_string();
    assert!(error.starts_with(&format!("zenoh_config {}", folder.path().join("none").display())), "{error}");
}
