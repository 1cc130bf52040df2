//! Prometheus metrics of plans and signatures.

use crate::common::{Program, checkpoint, from_bytes, from_file, plan_request};
use cpn::MethodKind;
use planner::model::RANDOM;
use tempfile::TempDir;
use testing::process::scrape;
use testing::signatures::{bundle, public_key};

#[tokio::test(flavor = "multi_thread")]
async fn plans_are_counted_and_their_stages_timed() {
    let program = Program::start(&[], |_| ()).await;
    for client in program.clients() {
        client.plan(plan_request(RANDOM, 1)).await.unwrap();
        client.plan(plan_request("unknown", 1)).await.unwrap_err();
    }
    let found = scrape(program.metrics);
    let mut expected =
        vec!["cpn_planner_plans_total 2".to_owned(), "cpn_planner_batch_size_bucket{le=\"1\"} 2".to_owned()];
    for stage in ["queue", "encode", "plan"] {
        expected.push(format!("cpn_planner_stage_seconds_bucket{{stage=\"{stage}\",le=\"10\"}} 2"));
        expected.push(format!("cpn_planner_stage_seconds_count{{stage=\"{stage}\"}} 2"));
    }
    for line in expected {
        assert!(found.contains(&line), "{line}: not in\n{found:#?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn refusals_and_warnings_are_counted_by_reason() {
    let keys = TempDir::new().unwrap();
    let trusted = keys.path().join("ours.pub.pem");
    std::fs::write(&trusted, public_key(1)).unwrap();
    let bytes = checkpoint(MethodKind::Cpn, 1);

    for (trust, counter) in
        [("enforce", "cpn_planner_checkpoints_refused_total"), ("warn", "cpn_planner_checkpoints_unverified_total")]
    {
        let program = Program::start(&[], |command| {
            command.args(["--trust", trust, "--trusted-keys"]).arg(&trusted);
        })
        .await;
        let [client, _] = program.clients();
        let folder = program.models_dir.path();
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
            assert_eq!(loaded.is_ok(), trust == "warn" || file == "good", "{trust} {file}");
        }
        let _ = client.load_model(from_bytes("cpn", bytes.clone())).await;

        let mut found = scrape(program.metrics);
        found.retain(|line| line.starts_with(counter));
        found.sort();
        let counts = [("malformed", 1), ("mismatch", 1), ("unsigned", 2), ("untrusted", 1)];
        assert_eq!(found, counts.map(|(reason, count)| format!("{counter}{{reason=\"{reason}\"}} {count}")));
    }
}
