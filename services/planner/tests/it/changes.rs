//! Refused state changes are logged and counted.

use crate::common::{Client, NAME, Program, from_bytes, from_file, raw_query};
use prost::Message as _;
use testing::process::scrape;
use wire::planner::{LoadModelResponse, UnloadModelResponse};
use wire::proto::planner_service_client::PlannerServiceClient;
use wire::{key, proto};

#[tokio::test(flavor = "multi_thread")]
async fn refused_changes_are_logged_and_counted() {
    let program = Program::start(&[], |_| ()).await;
    let mut remote = PlannerServiceClient::new(program.channel.clone());
    let session = &program.session;

    // One refused for its contents, one for its encoding, one because it comes too late to be read.
    Client::Grpc(remote.clone()).load_model(from_bytes("cpn", b"noise".to_vec())).await.unwrap_err();
    remote.load_model(from_file("cpn", "../secret")).await.unwrap_err();
    remote.load_model(from_bytes("cpn", vec![0; 70 << 20])).await.unwrap_err();
    remote.unload_model(proto::UnloadModelRequest { model: "unknown".into() }).await.unwrap_err();
    let (load, unload) = (key::planner_load_model(NAME).unwrap(), key::planner_unload_model(NAME).unwrap());
    let payload = Some(from_file("cpn", "absent.safetensors").encode_to_vec());
    raw_query::<LoadModelResponse>(session, &load, payload).await.unwrap_err();
    let payload = Some(proto::UnloadModelRequest { model: "random".into() }.encode_to_vec());
    raw_query::<UnloadModelResponse>(session, &unload, payload).await.unwrap_err();
    session.put(key::checkpoint_announcement("cpn").unwrap(), b"noise".to_vec()).await.unwrap();

    for (change, by, why) in [
        ("load_model", "127.0.0.1:", "checkpoint: expected one that can be loaded"),
        ("load_model", "127.0.0.1:", "file: expected 1 to 64 of a-z"),
        ("load_model", "127.0.0.1:", "payload: expected a shorter message"),
        ("unload_model", "127.0.0.1:", "model: expected one of random, got unknown"),
        ("load_model", load.as_str(), "file: expected a file in the model folder, got absent.safetensors"),
        ("unload_model", unload.as_str(), "model: expected a name other than random, got random"),
        ("announcement", "cpn/@v1/checkpoint/cpn/announcement", "payload: expected cpn.v1.CheckpointAnnouncement"),
    ] {
        let line = program.log.line("a change was refused");
        for part in [change, by, why] {
            assert!(line.contains(part), "{part} in {line}");
        }
    }
    let found = scrape(program.metrics);
    for (change, count) in [("load_model", 4), ("unload_model", 2), ("announcement", 1)] {
        let line = format!("cpn_planner_changes_refused_total{{change=\"{change}\"}} {count}");
        assert!(found.contains(&line), "{line} in\n{found:#?}");
    }
}
