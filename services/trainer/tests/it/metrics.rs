//! Prometheus metrics of recordings and runs.

#![expect(clippy::unwrap_used, reason = "a test")]

mod common;

use common::{episode, keep};
use futures::StreamExt;
use service_kit::SessionConfig;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use trainer::record::send;
use trainer::service;
use wire::training::StartRunRequest;

/// Scrapes the metrics.
async fn scrape(address: &str) -> String {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!("GET /metrics HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 200 OK"), "{answer}");
    answer
}

#[tokio::test(flavor = "multi_thread")]
async fn recordings_and_runs_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    keep(&folder.path().join("data"), &episode("reach", 1, 9));
    let (endpoint, metrics) = ("tcp/127.0.0.1:17495", "127.0.0.1:17496");
    let service = service::start(service::Config {
        dataset: folder.path().join("data"),
        checkpoints: folder.path().join("checkpoints"),
        runs: folder.path().join("runs"),
        grpc_listen: "127.0.0.1:0".parse().unwrap(),
        metrics_listen: Some(metrics.parse().unwrap()),
        program: env!("CARGO_BIN_EXE_cpn-trainer").into(),
        session: SessionConfig { listen: vec![endpoint.into()], ..SessionConfig::default() },
        ..service::Config::default()
    })
    .await
    .unwrap();
    let connecting = SessionConfig { connect: vec![endpoint.into()], ..SessionConfig::default() };
    let session = service_kit::session::open(&connecting).await.unwrap();
    send::send(&session, &episode("reach", 2, 7)).await.unwrap();

    let settings = "preset = \"paper-bc\"\nthreads = 1\ntraining.batch_size = 4\ntraining.epochs = 2".into();
    let request = StartRunRequest { name: "short".into(), settings, ..StartRunRequest::default() };
    service.runs().start(&request).unwrap();
    let heard: Vec<_> = service.runs().watch("short").unwrap().collect().await;
    let last = heard.last().unwrap().progress.unwrap();
    let expected = [
        "cpn_recorder_episodes_total 1".to_owned(),
        "cpn_recorder_steps_total 7".to_owned(),
        "cpn_training_steps_total{run=\"short\"} 8".to_owned(),
        "cpn_training_samples_total{run=\"short\"} 28".to_owned(),
        "cpn_training_epochs_total{run=\"short\"} 2".to_owned(),
        format!("cpn_training_loss{{run=\"short\"}} {}", last.loss),
        format!("cpn_training_learning_rate{{run=\"short\"}} {}", last.learning_rate),
        format!("cpn_training_gradient_norm{{run=\"short\"}} {}", last.gradient_norm),
        format!("cpn_training_samples_per_second{{run=\"short\"}} {}", last.samples_per_second),
        "cpn_training_running{run=\"short\"} 0".to_owned(),
    ];
    // Metrics are updated shortly after the run.
    let mut found = scrape(metrics).await;
    for _ in 0..100 {
        if found.contains(expected.last().unwrap()) {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        found = scrape(metrics).await;
    }
    for line in expected {
        assert!(found.lines().any(|found| found == line), "{line} in\n{found}");
    }
    session.close().await.unwrap();
    service.shutdown().await.unwrap();
}
