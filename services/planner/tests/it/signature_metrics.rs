//! Prometheus metrics of signatures, in a process of their own, so that no other test counts.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;
#[path = "common/signed.rs"]
mod signed;

use common::{Fixture, checkpoint, from_bytes, from_file};
use cpn::MethodKind;
use signed::{bundle, public_key};
use signing::Trust;
use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

/// Scraped samples of a counter.
async fn scrape(address: &str, name: &str) -> Vec<String> {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!("GET /metrics HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    let mut lines: Vec<_> = answer.lines().filter(|line| line.starts_with(name)).map(str::to_owned).collect();
    lines.sort();
    lines
}

#[tokio::test(flavor = "multi_thread")]
async fn refusals_and_warnings_are_counted_by_reason() {
    let address = "127.0.0.1:17498";
    let keys = TempDir::new().unwrap();
    let trusted = keys.path().join("ours.pub.pem");
    std::fs::write(&trusted, public_key(1)).unwrap();
    let bytes = checkpoint(MethodKind::Cpn, 1);

    let mut planners = Vec::new();
    for (trust, listen) in [(Trust::Enforce, Some(address)), (Trust::Warn, None)] {
        let fixture = Fixture::start(&[], |config| {
            config.metrics_listen = listen.map(|address| address.parse().unwrap());
            (config.trust, config.trusted_keys) = (Some(trust), vec![trusted.clone()]);
        })
        .await;
        let [client, ..] = fixture.clients();
        let folder = fixture.models_dir.path();
        for (file, bundle) in [
            ("good", Some(bundle(1, &bytes))),
            ("untrusted", Some(bundle(2, &bytes))),
            ("mismatch", Some(bundle(1, b"other"))),
            ("malformed", Some("{".into())),
            ("unsigned", None),
        ] {
            std::fs::write(folder.join(format!("{file}.safetensors")), &bytes).unwrap();
            if let Some(bundle) = bundle {
                std::fs::write(folder.join(format!("{file}.safetensors.sig")), bundle).unwrap();
            }
            let loaded = client.load_model(from_file("cpn", &format!("{file}.safetensors"))).await;
            assert_eq!(loaded.is_ok(), trust == Trust::Warn || file == "good", "{trust:?} {file}");
        }
        let _ = client.load_model(from_bytes("cpn", bytes.clone())).await;

        let counter = match trust {
            Trust::Enforce => "cpn_planner_checkpoints_refused_total",
            _ => "cpn_planner_checkpoints_unverified_total",
        };
        let counts = [("malformed", 1), ("mismatch", 1), ("unsigned", 2), ("untrusted", 1)];
        let expected = counts.map(|(reason, count)| format!("{counter}{{reason=\"{reason}\"}} {count}"));
        assert_eq!(scrape(address, counter).await, expected);
        planners.push(fixture);
    }
}
