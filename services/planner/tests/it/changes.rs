//! Refused state changes are logged and counted.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use common::{Client, PATIENCE, Process, from_bytes, from_file, raw_query};
use prost::Message as _;
use service_kit::SessionConfig;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::process::{Command, Stdio};
use std::sync::mpsc;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use wire::planner::{LoadModelResponse, UnloadModelResponse};
use wire::proto::planner_service_client::PlannerServiceClient;
use wire::{key, proto};

fn free() -> String {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string()
}

async fn scrape(address: &str) -> String {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!("GET /metrics HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    answer
}

#[tokio::test(flavor = "multi_thread")]
async fn refused_changes_are_logged_and_counted() {
    let (zenoh, grpc, metrics) = (format!("tcp/{}", free()), free(), free());
    let models = tempfile::TempDir::new().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-planner"));
    command.args(["--name", "noted", "--listen", &zenoh, "--grpc-listen", &grpc, "--metrics-listen", &metrics]);
    command.arg("--models-dir").arg(models.path()).env_remove("RUST_LOG").stderr(Stdio::piped());
    let mut process = Process(command.spawn().unwrap());
    let (sender, log) = mpsc::channel();
    let stderr = BufReader::new(process.0.stderr.take().unwrap());
    std::thread::spawn(move || stderr.lines().map_while(Result::ok).for_each(|line| drop(sender.send(line))));

    let config = SessionConfig { connect: vec![zenoh], ..SessionConfig::default() };
    let session = service_kit::session::open(&config).await.unwrap();
    let alive = session.liveliness().declare_subscriber(key::planner_alive("noted").unwrap()).history(true);
    common::soon(alive.await.unwrap().recv_async()).await.unwrap();
    let mut remote = PlannerServiceClient::connect(format!("http://{grpc}")).await.unwrap();

    // One refused for its contents, one for its encoding, one because it comes too late to be read.
    Client::Grpc(remote.clone()).load_model(from_bytes("cpn", b"noise".to_vec())).await.unwrap_err();
    remote.load_model(from_file("cpn", "../secret")).await.unwrap_err();
    remote.load_model(from_bytes("cpn", vec![0; 70 << 20])).await.unwrap_err();
    remote.unload_model(proto::UnloadModelRequest { model: "unknown".into() }).await.unwrap_err();
    let (load, unload) = (key::planner_load_model("noted").unwrap(), key::planner_unload_model("noted").unwrap());
    let payload = Some(from_file("cpn", "absent.safetensors").encode_to_vec());
    raw_query::<LoadModelResponse>(&session, &load, payload).await.unwrap_err();
    let payload = Some(proto::UnloadModelRequest { model: "random".into() }.encode_to_vec());
    raw_query::<UnloadModelResponse>(&session, &unload, payload).await.unwrap_err();
    session.put(key::checkpoint_announcement("cpn").unwrap(), b"noise".to_vec()).await.unwrap();

    for (change, by, why) in [
        ("load_model", "127.0.0.1:", "checkpoint: expected one that can be loaded"),
        ("load_model", "127.0.0.1:", "file: expected 1 to 64 of a-z"),
        ("load_model", "127.0.0.1:", "payload: expected a shorter message"),
        ("unload_model", "127.0.0.1:", "model: expected one of random, got unknown"),
        ("load_model", load.as_str(), "file: expected a file in the model folder, got absent.safetensors"),
        ("unload_model", unload.as_str(), "model: expected a name other than random, got random"),
        ("announcement", "cpn/@v1/checkpoint/cpn/announcement", "payload: expected cpn.v1.CheckpointAnnouncement"),
    ] {
        let line = loop {
            let line = log.recv_timeout(PATIENCE).unwrap_or_else(|_| panic!("no line of {change} by {by}: {why}"));
            if line.contains("a change was refused") {
                break line;
            }
        };
        for part in [change, by, why] {
            assert!(line.contains(part), "{part} in {line}");
        }
    }
    let found = scrape(&metrics).await;
    for (change, count) in [("load_model", 4), ("unload_model", 2), ("announcement", 1)] {
        let line = format!("cpn_planner_changes_refused_total{{change=\"{change}\"}} {count}");
        assert!(found.lines().any(|found| found == line), "{line} in\n{found}");
    }
}
