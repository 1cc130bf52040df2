//! Refusals of clients without a valid certificate.

use crate::common::{Network, authority, config};
use certs::Authority;
use service_kit::SessionConfig;
use std::collections::BTreeSet;
use std::os::unix::fs::PermissionsExt;
use std::time::Duration;
use tempfile::tempdir;
use wire::planner::{ListModelsRequest, ListModelsResponse};
use wire::{Code, Error, key, query};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;

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

async fn list_models(session: &Session, key: &OwnedKeyExpr) -> Result<ListModelsResponse, Error> {
    query::call(session, key, ListModelsRequest, PATIENCE).await
}

/// Whether a session gets an answer in time. It asks until then: declarations take time to arrive.
async fn gets_an_answer(session: &Session, key: &OwnedKeyExpr) -> bool {
    let answered = async {
        while list_models(session, key).await.is_err() {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    tokio::time::timeout(PATIENCE, answered).await.is_ok()
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
    let (client, evaluator) = (network.session("client").await, network.session("evaluator").await);
    let planner = network.session("planner").await;
    let key = key::planner_list_models("p").unwrap();
    let answer = |query: zenoh::query::Query| {
        query::reply(&query, Ok(ListModelsResponse { models: Vec::new() })).unwrap();
    };
    let _queryable = planner.declare_queryable(&key).complete(true).callback(answer).await.unwrap();
    assert!(gets_an_answer(&client, &key).await);

    network.authority().revoke("client").unwrap();
    network.restart().await;
    while !service_kit::session::is_connected(&client).await {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    assert!(gets_an_answer(&evaluator, &key).await, "the planner's declaration has arrived at the router");
    let error = list_models(&client, &key).await.unwrap_err();
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
