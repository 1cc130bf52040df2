//! Refused state changes are logged and counted.

use crate::common::{NAME, Program};
use testing::process::{PATIENCE, scrape};
use wire::checkpoint::{PromoteVersionRequest, PromoteVersionResponse, RollBackRequest, RollBackResponse};
use wire::proto::trainer_service_client::TrainerServiceClient;
use wire::training::{StartRunRequest, StartRunResponse, StopRunRequest, StopRunResponse};
use wire::{key, proto, query};

#[tokio::test(flavor = "multi_thread")]
async fn refused_changes_are_logged_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let program = Program::start(folder.path()).await;
    let mut remote = TrainerServiceClient::connect(format!("http://{}", program.grpc)).await.unwrap();
    let session = &program.session;

    remote.start_run(proto::StartRunRequest { name: "../x".into(), ..Default::default() }).await.unwrap_err();
    remote.stop_run(proto::StopRunRequest { name: "unknown".into() }).await.unwrap_err();
    let keys = [
        key::trainer_start_run(NAME).unwrap(),
        key::trainer_stop_run(NAME).unwrap(),
        key::checkpoint_promote("cpn").unwrap(),
        key::checkpoint_roll_back("cpn").unwrap(),
    ];
    let [start, stop, promote, roll_back] = &keys;
    let request = StartRunRequest { name: "x".into(), settings: "preset = 'unknown'".into(), ..Default::default() };
    query::call::<_, StartRunResponse>(session, start, request, PATIENCE).await.unwrap_err();
    let request = StopRunRequest { name: "unknown".into() };
    query::call::<_, StopRunResponse>(session, stop, request, PATIENCE).await.unwrap_err();
    let request = PromoteVersionRequest { model: "cpn".into(), version: 7 };
    query::call::<_, PromoteVersionResponse>(session, promote, request, PATIENCE).await.unwrap_err();
    let request = RollBackRequest { model: "cpn".into() };
    query::call::<_, RollBackResponse>(session, roll_back, request, PATIENCE).await.unwrap_err();

    for (change, by, why) in [
        ("start_run", "127.0.0.1:", "name: expected 1 to 64 of a-z"),
        ("stop_run", "127.0.0.1:", "got \"unknown\""),
        ("start_run", start.as_str(), "expected"),
        ("stop_run", stop.as_str(), "got \"unknown\""),
        ("promote", promote.as_str(), "expected"),
        ("roll_back", roll_back.as_str(), "expected"),
    ] {
        let line = program.log.line("a change was refused");
        for part in [change, by, why] {
            assert!(line.contains(part), "{part} in {line}");
        }
    }
    let found = scrape(program.metrics);
    for (change, count) in [("start_run", 2), ("stop_run", 2), ("promote", 1), ("roll_back", 1)] {
        let line = format!("cpn_trainer_changes_refused_total{{change=\"{change}\"}} {count}");
        assert!(found.contains(&line), "{line} in\n{found:#?}");
    }
}
