//! Refused state changes are logged and counted.

#![expect(clippy::unwrap_used, reason = "a test")]

use service_kit::SessionConfig;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use wire::checkpoint::{PromoteVersionRequest, PromoteVersionResponse, RollBackRequest, RollBackResponse};
use wire::proto::trainer_service_client::TrainerServiceClient;
use wire::training::{StartRunRequest, StartRunResponse, StopRunRequest, StopRunResponse};
use wire::{key, proto, query};

const PATIENCE: Duration = Duration::from_secs(60);

/// Process of a trainer, killed when dropped.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

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
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-trainer"));
    command.args(["serve", "--listen", &zenoh, "--grpc-listen", &grpc, "--metrics-listen", &metrics]);
    for option in ["dataset", "checkpoints", "runs"] {
        command.arg(format!("--{option}")).arg(folder.path().join(option));
    }
    let mut process = Process(command.env_remove("RUST_LOG").stderr(Stdio::piped()).spawn().unwrap());
    let (sender, log) = mpsc::channel();
    let stderr = BufReader::new(process.0.stderr.take().unwrap());
    std::thread::spawn(move || stderr.lines().map_while(Result::ok).for_each(|line| drop(sender.send(line))));

    let config = SessionConfig { connect: vec![zenoh], ..SessionConfig::default() };
    let session = service_kit::session::open(&config).await.unwrap();
    let alive = session.liveliness().declare_subscriber(key::trainer_alive("trainer").unwrap()).history(true);
    tokio::time::timeout(PATIENCE, alive.await.unwrap().recv_async()).await.unwrap().unwrap();
    let mut remote = TrainerServiceClient::connect(format!("http://{grpc}")).await.unwrap();

    remote.start_run(proto::StartRunRequest { name: "../x".into(), ..Default::default() }).await.unwrap_err();
    remote.stop_run(proto::StopRunRequest { name: "unknown".into() }).await.unwrap_err();
    let keys = [
        key::trainer_start_run("trainer").unwrap(),
        key::trainer_stop_run("trainer").unwrap(),
        key::checkpoint_promote("cpn").unwrap(),
        key::checkpoint_roll_back("cpn").unwrap(),
    ];
    let [start, stop, promote, roll_back] = &keys;
    let request = StartRunRequest { name: "x".into(), settings: "preset = 'unknown'".into(), ..Default::default() };
    query::call::<_, StartRunResponse>(&session, start, request, PATIENCE).await.unwrap_err();
    let request = StopRunRequest { name: "unknown".into() };
    query::call::<_, StopRunResponse>(&session, stop, request, PATIENCE).await.unwrap_err();
    let request = PromoteVersionRequest { model: "cpn".into(), version: 7 };
    query::call::<_, PromoteVersionResponse>(&session, promote, request, PATIENCE).await.unwrap_err();
    let request = RollBackRequest { model: "cpn".into() };
    query::call::<_, RollBackResponse>(&session, roll_back, request, PATIENCE).await.unwrap_err();

    for (change, by, why) in [
        ("start_run", "127.0.0.1:", "name: expected 1 to 64 of a-z"),
        ("stop_run", "127.0.0.1:", "got \"unknown\""),
        ("start_run", start.as_str(), "expected"),
        ("stop_run", stop.as_str(), "got \"unknown\""),
        ("promote", promote.as_str(), "expected"),
        ("roll_back", roll_back.as_str(), "expected"),
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
    for (change, count) in [("start_run", 2), ("stop_run", 2), ("promote", 1), ("roll_back", 1)] {
        let line = format!("cpn_trainer_changes_refused_total{{change=\"{change}\"}} {count}");
        assert!(found.lines().any(|found| found == line), "{line} in\n{found}");
    }
}
