//! Prometheus metrics of recordings and runs.

use crate::common::{NAME, Program, episode, keep};
use std::time::Duration;
use testing::process::scrape;
use trainer::record::send;
use trainer::runs::client;
use wire::training::StartRunRequest;

#[tokio::test(flavor = "multi_thread")]
async fn recordings_and_runs_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    keep(&folder.path().join("data"), &episode("reach", 1, 9));
    let program = Program::start(folder.path()).await;
    let session = &program.session;
    send::send(session, &episode("reach", 2, 7)).await.unwrap();

    let settings = "preset = \"paper-bc\"\nthreads = 1\ntraining.batch_size = 4\ntraining.epochs = 2".into();
    let request = StartRunRequest { name: "short".into(), settings, ..StartRunRequest::default() };
    client::start(session, NAME, request).await.unwrap();
    let last = client::watch(session, NAME, "short").await.unwrap().progress.unwrap();
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
    let mut found = scrape(program.metrics);
    for _ in 0..100 {
        if found.contains(expected.last().unwrap()) {
            break;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
        found = scrape(program.metrics);
    }
    for line in expected {
        assert!(found.contains(&line), "{line} in\n{found:#?}");
    }
}
