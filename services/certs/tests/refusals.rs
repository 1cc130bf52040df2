//! Refusals of clients without a valid certificate.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use certs::Authority;
use common::{Network, authority, config};
use service_kit::SessionConfig;
use std::collections::BTreeSet;
use std::os::unix::fs::PermissionsExt;
use std::time::Duration;
use tempfile::tempdir;
use wire::{Code, key, query};

/// Timeout of a known identity's connection.
const PATIENCE: Duration = Duration::from_secs(60);
/// Wait for a connection that must not succeed.
const DENIED: Duration = Duration::from_secs(3);

async fn gets_in(config: &SessionConfig, within: Duration) -> bool {
    match tokio::time::timeout(within, service_kit::session::open(config)).await {
        Ok(session) => service_kit::session::is_connected(&session.unwrap()).await,
        Err(_) => false,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn only_a_valid_certificate_of_the_authority_connects() {
    let network = Network::start().await;
    assert!(gets_in(&network.config("client"), PATIENCE).await);

    // A client of another authority, which trusts the router.
    let other = tempdir().unwrap();
    authority(other.path()).init(&BTreeSet::new(), BTreeSet::new()).unwrap();
    std::fs::copy(network.files("client").join("ca.pem"), other.path().join("client/ca.pem")).unwrap();
    assert!(!gets_in(&config(&other.path().join("client"), network.port), DENIED).await);

    // An expired certificate.
    Authority::open(network.folder.path(), 0).unwrap().issue("client.late", &BTreeSet::new()).unwrap();
    assert!(!gets_in(&network.config("client.late"), DENIED).await);

    // Neither certificate nor encryption.
    let plain = SessionConfig {
        tls_ca: None,
        tls_certificate: None,
        tls_private_key: None,
        connect: vec![format!("tcp/127.0.0.1:{}", network.port)],
        ..network.config("client")
    };
    assert!(!gets_in(&plain, DENIED).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_revoked_identity_is_denied_everything_for_good() {
    let mut network = Network::start().await;
    let hosts = BTreeSet::new();
    let (client, planner) = (network.session("client").await, network.session("planner").await);
    let key = key::planner_list_models("p").unwrap();
    let answer = |query: zenoh::query::Query| {
        query::reply(&query, Ok(wire::planner::ListModelsResponse { models: Vec::new() })).unwrap();
    };
    let _queryable = planner.declare_queryable(&key).complete(true).callback(answer).await.unwrap();
    let ask = || {
        query::call::<_, wire::planner::ListModelsResponse>(&client, &key, wire::planner::ListModelsRequest, PATIENCE)
    };
    ask().await.unwrap();

    network.authority().revoke("client").unwrap();
    network.restart().await;
    for session in [&client, &planner] {
        while !service_kit::session::is_connected(session).await {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }
    let error = ask().await.unwrap_err();
    assert_eq!(error.code, Code::Unavailable, "{error}");
    let error = network.authority().issue("client", &hosts).unwrap_err().to_string();
    assert_eq!(error, "identity: expected one that was not revoked, got client");
}

#[test]
fn the_authority_keeps_valid_certificates_renews_others_and_protects_its_keys() {
    let folder = tempdir().unwrap();
    let read = |file: &str| std::fs::read(folder.path().join(file)).unwrap();
    let none = BTreeSet::new();
    Authority::open(folder.path(), 90).unwrap().init(&none, none.clone()).unwrap();
    let first = read("planner/certificate.pem");
    Authority::open(folder.path(), 90).unwrap().init(&none, none.clone()).unwrap();
    assert_eq!(read("planner/certificate.pem"), first, "nothing was due");
    let hosts = BTreeSet::from(["planner-0".to_owned()]);
    Authority::open(folder.path(), 90).unwrap().init(&hosts, none.clone()).unwrap();
    let with_host = read("planner/certificate.pem");
    assert_ne!(with_host, first, "a host came to it");
    Authority::open(folder.path(), 0).unwrap().renew(&["planner".to_owned()]).unwrap();
    let ended = read("planner/certificate.pem");
    let mut authority = Authority::open(folder.path(), 90).unwrap();
    authority.init(&hosts, none).unwrap();
    assert_ne!(read("planner/certificate.pem"), ended, "it had ended");
    assert_eq!(authority.identities().identities["planner"].serials.len(), 4);

    for secret in ["authority/private-key.pem", "planner/private-key.pem"] {
        let mode = folder.path().join(secret).metadata().unwrap().permissions().mode();
        assert_eq!(mode & 0o077, 0, "{secret}: {mode:o}");
    }
    for (identity, got) in [("pilot", "pilot"), ("planner.", "\"planner.\""), ("planner.../x", "\"planner.../x\"")] {
        let error = authority.issue(identity, &hosts).unwrap_err().to_string();
        assert!(error.ends_with(&format!("got {got}")), "{error}");
    }
}
