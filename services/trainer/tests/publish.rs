//! A planner that is up, and one that comes later, serve what the trainer publishes.

#![expect(clippy::unwrap_used, reason = "a test")]

use cpn::checkpoint::{self, Provenance};
use cpn::{Agent, MethodKind, ModelConfig};
use service_kit::{SessionConfig, files};
use std::path::Path;
use std::time::Duration;
use trainer::service;
use wire::planner::ModelInfo;

fn publish(folder: &Path, seed: u64) -> String {
    let agent = Agent::new(ModelConfig::paper(MethodKind::TeBc), seed);
    let provenance = Provenance {
        training_tasks: vec!["reach".into()],
        data_digest: String::new(),
        render_spec: String::new(),
        seed,
        epochs: 1,
    };
    let bytes = checkpoint::to_bytes(&agent, &provenance).unwrap();
    files::write_atomically(&folder.join("te-bc.safetensors"), &bytes).unwrap();
    checkpoint::digest(&bytes)
}

async fn start_planner(folder: &Path, name: &str, endpoint: &str) -> planner::Planner {
    let config = planner::Config {
        name: name.into(),
        models_dir: folder.join("none"),
        grpc_listen: "127.0.0.1:0".parse().unwrap(),
        session: SessionConfig { connect: vec![endpoint.into()], ..SessionConfig::default() },
        ..planner::Config::default()
    };
    planner::start(config).await.unwrap()
}

/// Waits until the planner serves a checkpoint.
async fn served(planner: &planner::Planner, digest: &str) -> ModelInfo {
    let wait = async {
        loop {
            let models = planner.core().list_models().models;
            if let Some(info) = models.into_iter().find(|info| info.digest == digest) {
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
    let endpoint = "tcp/127.0.0.1:17461";
    let checkpoints = folder.path().join("checkpoints");
    let trainer = service::start(service::Config {
        dataset: folder.path().join("data"),
        checkpoints: checkpoints.clone(),
        runs: folder.path().join("runs"),
        grpc_listen: "127.0.0.1:0".parse().unwrap(),
        session: SessionConfig { listen: vec![endpoint.into()], ..SessionConfig::default() },
        ..service::Config::default()
    })
    .await
    .unwrap();

    let early = start_planner(folder.path(), "early", endpoint).await;
    let first = publish(&checkpoints, 1);
    let info = served(&early, &first).await;
    assert_eq!((info.name.as_str(), info.method.as_str()), ("te-bc", "te-bc"));
    assert_eq!(info.training_tasks, ["reach"]);

    let late = start_planner(folder.path(), "late", endpoint).await;
    served(&late, &first).await;

    let second = publish(&checkpoints, 2);
    served(&early, &second).await;
    served(&late, &second).await;
    for planner in [early, late] {
        planner.shutdown().await.unwrap();
    }
    trainer.shutdown().await.unwrap();
}
