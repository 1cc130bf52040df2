//! A recorder that is killed repeatedly, at random moments, loses no acknowledged episode.

use crate::common::{episode, files};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use recording::Episode;
use service_kit::SessionConfig;
use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::task::JoinSet;
use trainer::record::send;
use wire::key;
use zenoh::Session;
use zenoh::sample::SampleKind;

/// Number of concurrent senders.
const SENDERS: u64 = 3;
const STEPS: u32 = 4;

#[tokio::test(flavor = "multi_thread")]
async fn a_recorder_that_is_killed_loses_nothing() {
    survives(20, "tcp/127.0.0.1:17491").await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes a minute: `make test-crash`"]
async fn a_recorder_that_is_killed_a_hundred_times_loses_nothing() {
    survives(100, "tcp/127.0.0.1:17492").await;
}

/// The real service, which connects to the sender, so that it is reachable as soon as it is up.
fn start(folder: &Path, endpoint: &str) -> Child {
    Command::new(env!("CARGO_BIN_EXE_cpn-trainer"))
        .args(["serve", "--connect", endpoint, "--dataset"])
        .arg(folder.join("data"))
        .arg("--checkpoints")
        .arg(folder.join("checkpoints"))
        .arg("--runs")
        .arg(folder.join("runs"))
        .args(["--grpc-listen", "127.0.0.1:0"])
        .env("RUST_LOG", "error")
        .stdin(Stdio::null())
        .spawn()
        .unwrap()
}

/// Sends episodes until stopped, and returns them.
async fn stream(session: Session, first: u64, kept: Arc<Mutex<BTreeSet<u64>>>, stop: Arc<Mutex<bool>>) -> Vec<Episode> {
    let mut sent = Vec::new();
    for seed in (first..).step_by(SENDERS as usize) {
        let episode = episode("reach", seed, STEPS);
        send::send(&session, &episode).await.unwrap();
        kept.lock().unwrap().insert(seed);
        sent.push(episode);
        if *stop.lock().unwrap() {
            break;
        }
    }
    sent
}

async fn survives(kills: u32, endpoint: &str) {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    let listening = SessionConfig { listen: vec![endpoint.into()], ..SessionConfig::default() };
    let session = service_kit::session::open(&listening).await.unwrap();
    let (kept, stop) = (Arc::new(Mutex::new(BTreeSet::new())), Arc::new(Mutex::new(false)));
    let mut senders = JoinSet::new();
    for first in 0..SENDERS {
        senders.spawn(stream(session.clone(), first, Arc::clone(&kept), Arc::clone(&stop)));
    }
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let heard = session.declare_subscriber(key::demonstration_recorded("*").unwrap()).await.unwrap();
    for _ in 0..kills {
        let mut recorder = start(folder.path(), endpoint);
        // Killed at a random moment after it works.
        let sample =
            tokio::time::timeout(Duration::from_secs(60), heard.recv_async()).await.expect("a recorder").unwrap();
        assert_eq!(sample.kind(), SampleKind::Put);
        tokio::time::sleep(Duration::from_micros(rng.random_range(0..200_000))).await;
        recorder.kill().unwrap();
        recorder.wait().unwrap();
        drop(heard.drain());
        let acknowledged = kept.lock().unwrap().clone();
        for seed in acknowledged {
            let path = data.join(format!("reach/reach-{seed}.mcap"));
            assert!(path.exists(), "{}: acknowledged, and gone", path.display());
        }
    }
    *stop.lock().unwrap() = true;
    let mut recorder = start(folder.path(), endpoint);
    let mut sent = Vec::new();
    while let Some(episodes) = senders.join_next().await {
        sent.extend(episodes.unwrap());
    }
    recorder.kill().unwrap();
    recorder.wait().unwrap();

    let expected = sent
        .iter()
        .map(|episode| (format!("reach/{}.mcap", episode.info().episode_id), recording::to_bytes(episode).unwrap()));
    let mut expected: Vec<_> = expected.collect();
    expected.sort();
    assert!(expected.len() >= kills as usize / 2, "most lives kept something");
    assert!(files(&data) == expected, "every episode, and each as it was sent");
    let report = trainer::record::verify::run(&data, 1, expected.len()).unwrap();
    assert_eq!(report.faults, Vec::<String>::new());
    let left: Vec<_> = std::fs::read_dir(data.join("reach")).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left.len(), expected.len(), "nothing unfinished is left: {left:?}");
}
