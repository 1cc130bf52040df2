//! Published, promoted and rolled-back versions reach a running planner, and one that starts later.

use crate::common::{self, checkpoint};
use service_kit::{SessionConfig, files};
use signing::Trust;
use std::path::Path;
use std::process::Output;
use std::time::Duration;
use testing::signatures::{bundle, public_key};
use tokio::process::Command;
use trainer::service::{self, Service};
use wire::planner::ModelInfo;

/// Writes a checkpoint as a training run does; returns its digest.
fn write(folder: &Path, seed: u64) -> String {
    let bytes = checkpoint(seed);
    files::write_atomically(&folder.join("checkpoints/cpn.safetensors"), &bytes).unwrap();
    cpn::checkpoint::digest(&bytes)
}

async fn start_trainer(folder: &Path, endpoint: &str) -> Service {
    let config = service::Config {
        dataset: folder.join("data"),
        checkpoints: folder.join("checkpoints"),
        runs: folder.join("runs"),
        grpc_listen: "127.0.0.1:0".parse().unwrap(),
        session: SessionConfig { listen: vec![endpoint.into()], ..SessionConfig::default() },
        ..service::Config::default()
    };
    service::start(config).await.unwrap()
}

async fn start_planner(folder: &Path, name: &str, endpoint: &str) -> planner::Planner {
    planner::start(planner_config(folder, name, endpoint)).await.unwrap()
}

fn planner_config(folder: &Path, name: &str, endpoint: &str) -> planner::Config {
    let models_dir = folder.join("none");
    std::fs::create_dir_all(&models_dir).unwrap();
    planner::Config {
        name: name.into(),
        models_dir,
        grpc_listen: "127.0.0.1:0".parse().unwrap(),
        session: SessionConfig { connect: vec![endpoint.into()], ..SessionConfig::default() },
        ..planner::Config::default()
    }
}

/// Waits until the planner serves a version.
async fn served(planner: &planner::Planner, version: u32, digest: &str) -> ModelInfo {
    let wait = async {
        loop {
            let models = planner.core().list_models().models;
            if let Some(info) = models.into_iter().find(|info| (info.version, &*info.digest) == (version, digest)) {
                return info;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), wait).await.expect("the checkpoint to be served")
}

#[tokio::test(flavor = "multi_thread")]
async fn checkpoints_reach_every_planner() {
    let folder = tempfile::tempdir().unwrap();
    let (folder, endpoint) = (folder.path(), "tcp/127.0.0.1:17461");
    let trainer = start_trainer(folder, endpoint).await;
    let early = start_planner(folder, "early", endpoint).await;
    let first = write(folder, 1);
    let info = served(&early, 1, &first).await;
    assert_eq!((info.name.as_str(), info.method.as_str()), ("cpn", "cpn"));
    assert_eq!(info.training_tasks, ["reach"]);

    let late = start_planner(folder, "late", endpoint).await;
    served(&late, 1, &first).await;
    let second = write(folder, 2);
    served(&early, 2, &second).await;
    served(&late, 2, &second).await;

    // A restarted trainer announces the version promoted last, not the one written last.
    let connecting = SessionConfig { connect: vec![endpoint.into()], ..SessionConfig::default() };
    let session = service_kit::session::open(&connecting).await.unwrap();
    assert_eq!(trainer::publish::roll_back(&session, "cpn".into()).await.unwrap().digest, first);
    served(&early, 1, &first).await;
    session.close().await.unwrap();
    trainer.shutdown().await.unwrap();
    let trainer = start_trainer(folder, endpoint).await;
    let later = start_planner(folder, "later", endpoint).await;
    served(&later, 1, &first).await;
    served(&late, 1, &first).await;
    let third = write(folder, 3);
    for planner in [early, late, later] {
        served(&planner, 3, &third).await;
        planner.shutdown().await.unwrap();
    }
    trainer.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn versions_are_listed_promoted_and_rolled_back_from_the_command_line() {
    let folder = tempfile::tempdir().unwrap();
    let (folder, endpoint) = (folder.path(), "tcp/127.0.0.1:17462");
    let trainer = start_trainer(folder, endpoint).await;
    let planner = start_planner(folder, "planner", endpoint).await;
    let first = write(folder, 1);
    served(&planner, 1, &first).await;
    let second = write(folder, 2);
    served(&planner, 2, &second).await;

    let run = async |arguments: &[&str]| -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-trainer"));
        command.args(arguments).args(["--connect", endpoint]).output().await.unwrap()
    };
    let says = |output: &Output| String::from_utf8(output.stdout.clone()).unwrap();
    let listed = run(&["versions", "cpn", "--json"]).await;
    let listed: serde_json::Value = serde_json::from_slice(&listed.stdout).unwrap();
    assert_eq!(
        (&listed[0]["version"], &listed[0]["digest"], &listed[0]["promoted"]),
        (&1.into(), &first.into(), &false.into())
    );
    assert_eq!((&listed[1]["version"], &listed[1]["promoted"]), (&2.into(), &true.into()));
    assert_eq!((&listed[1]["parents"][0], &listed[2]), (&common::DATA_DIGEST.into(), &serde_json::Value::Null));

    let promoted = run(&["promote", "cpn", "1"]).await;
    assert_eq!(says(&promoted), "cpn 1 is promoted\n");
    served(&planner, 1, &cpn::checkpoint::digest(&checkpoint(1))).await;
    let rolled_back = run(&["rollback", "cpn"]).await;
    assert_eq!(says(&rolled_back), "cpn 2 is promoted\n");
    served(&planner, 2, &second).await;

    let table = says(&run(&["versions"]).await);
    let row = table.lines().find(|line| line.contains("yes")).unwrap();
    let cells: Vec<_> = row.split_whitespace().collect();
    assert_eq!((cells[0], cells[1], cells[4]), ("cpn", "2", &second[..12]), "{table}");
    for (arguments, reason) in [
        (&["promote", "cpn", "3"][..], "version: expected one of [1, 2], got 3"),
        (&["promote", "cpn", "0"], "version: expected 1 or more, got 0"),
        (&["rollback", "gpt"], "model: expected one of cpn, got gpt"),
        (&["versions", "gpt"], "model: expected one of cpn, got gpt"),
        (&["rollback", "a/b"], "got \"a/b\""),
    ] {
        let refused = run(arguments).await;
        let said = String::from_utf8(refused.stderr).unwrap();
        assert!(!refused.status.success() && said.contains(reason), "{arguments:?}: {said}");
    }
    planner.shutdown().await.unwrap();
    trainer.shutdown().await.unwrap();
}

/// A planner that enforces signatures serves a version once it is signed, without a further promotion.
#[tokio::test(flavor = "multi_thread")]
async fn a_signature_reaches_planners_after_its_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let (folder, endpoint) = (folder.path(), "tcp/127.0.0.1:17463");
    let keys = folder.join("ours.pub.pem");
    std::fs::write(&keys, public_key(1)).unwrap();
    let trainer = start_trainer(folder, endpoint).await;
    let strict = planner::Config {
        trust: Some(Trust::Enforce),
        trusted_keys: vec![keys],
        ..planner_config(folder, "strict", endpoint)
    };
    let (strict, lax) = (planner::start(strict).await.unwrap(), start_planner(folder, "lax", endpoint).await);
    let sign = |key: u8, seed: u64| {
        let path = folder.join("checkpoints/cpn.safetensors.sig");
        files::write_atomically(&path, bundle(key, &checkpoint(seed)).as_bytes()).unwrap();
    };

    let first = write(folder, 1);
    sign(1, 1);
    served(&lax, 1, &first).await;
    served(&strict, 1, &first).await;
    let second = write(folder, 2);
    served(&lax, 2, &second).await;
    sign(2, 2);
    // The next checkpoint is announced after that.
    files::write_atomically(&folder.join("checkpoints/other.safetensors"), &checkpoint(3)).unwrap();
    served(&lax, 1, &cpn::checkpoint::digest(&checkpoint(3))).await;
    let models = strict.core().list_models().models;
    let versions: Vec<_> = models.iter().map(|info| (info.name.as_str(), info.version)).collect();
    assert_eq!(versions, [("cpn", 1), ("random", 0)], "neither the stranger's nor the unsigned one");

    sign(1, 2);
    served(&strict, 2, &second).await;
    for planner in [strict, lax] {
        planner.shutdown().await.unwrap();
    }
    trainer.shutdown().await.unwrap();
}
