//! Prometheus metrics of plans.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use common::{Fixture, plan_request};
use planner::model::RANDOM;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

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
async fn plans_are_counted_and_their_stages_timed() {
    let metrics = "127.0.0.1:17497";
    let fixture = Fixture::start(&[], |config| config.metrics_listen = Some(metrics.parse().unwrap())).await;
    for client in fixture.clients() {
        client.plan(plan_request(RANDOM, 1)).await.unwrap();
        client.plan(plan_request("unknown", 1)).await.unwrap_err();
    }
    let found = scrape(metrics).await;
    let mut expected =
        vec!["cpn_planner_plans_total 3".to_owned(), "cpn_planner_batch_size_bucket{le=\"1\"} 3".to_owned()];
    for stage in ["queue", "encode", "plan"] {
        expected.push(format!("cpn_planner_stage_seconds_bucket{{stage=\"{stage}\",le=\"10\"}} 3"));
        expected.push(format!("cpn_planner_stage_seconds_count{{stage=\"{stage}\"}} 3"));
    }
    for line in expected {
        assert!(found.lines().any(|found| found == line), "{line}: not in\n{found}");
    }
}
