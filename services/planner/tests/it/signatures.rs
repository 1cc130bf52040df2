//! Unverified checkpoints are refused, or served with a warning, from every source.

use crate::common::{Client, Fixture, checkpoint, from_bytes, from_file, soon};
use cpn::MethodKind;
use planner::Config;
use service_kit::SessionConfig;
use signing::Trust;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use tempfile::TempDir;
use testing::signatures::{bundle, public_key};
use wire::checkpoint::{CheckpointAnnouncement, CheckpointChunkRequest, CheckpointChunkResponse, CheckpointManifest};
use wire::{Code, key, query};
use zenoh::Session;
use zenoh::query::Queryable;

/// Seed of the trusted key.
const OURS: u8 = 1;
/// Seed of another key.
const STRANGER: u8 = 2;

fn cpn(seed: u64) -> Vec<u8> {
    checkpoint(MethodKind::Cpn, seed)
}

/// Writes a file with the trusted public key.
fn trusted_keys(folder: &Path) -> Vec<PathBuf> {
    let path = folder.join("ours.pub.pem");
    std::fs::write(&path, public_key(OURS)).unwrap();
    vec![path]
}

fn write(folder: &Path, file: &str, bytes: &[u8], bundle: Option<&str>) {
    std::fs::write(folder.join(file), bytes).unwrap();
    if let Some(bundle) = bundle {
        std::fs::write(folder.join(format!("{file}.sig")), bundle).unwrap();
    }
}

/// Starts a planner with the model `cpn`, signed by the trusted key.
async fn start(trust: Option<Trust>, keys: &TempDir) -> Fixture {
    let trusted_keys = trusted_keys(keys.path());
    Fixture::start(&[("cpn", cpn(1))], |config| {
        write(&config.models_dir, "cpn.safetensors", &cpn(1), Some(&bundle(OURS, &cpn(1))));
        (config.trust, config.trusted_keys) = (trust, trusted_keys);
    })
    .await
}

/// Error of starting a planner of this folder.
async fn no_start(models_dir: &Path, trust: Option<Trust>, trusted_keys: Vec<PathBuf>) -> String {
    let config = Config {
        models_dir: models_dir.into(),
        grpc_listen: ([127, 0, 0, 1], 0).into(),
        session: SessionConfig::default(),
        trust,
        trusted_keys,
        ..Config::default()
    };
    format!("{:#}", planner::start(config).await.unwrap_err())
}

/// Invalid bundles for a checkpoint, each with a part of its error.
fn wrong_bundles(bytes: &[u8]) -> [(Option<String>, &'static str); 5] {
    let good = bundle(OURS, bytes);
    [
        (None, "signature: expected a bundle for "),
        (Some(bundle(STRANGER, bytes)), "signature: expected one by key "),
        (Some(bundle(OURS, b"something else")), "signature: expected one of the digest "),
        (Some(good[..good.len() - 1].into()), "signature: expected a bundle in JSON, got EOF"),
        (Some(" ".repeat(70_000)), "signature: expected at most 65536 bytes, got 65537 bytes"),
    ]
}

#[tokio::test(flavor = "multi_thread")]
async fn every_checkpoint_of_the_folder_is_checked_at_the_start() {
    let keys = TempDir::new().unwrap();
    let trusted_keys = trusted_keys(keys.path());
    for (wrong, reason) in wrong_bundles(&cpn(2)) {
        let folder = TempDir::new().unwrap();
        write(folder.path(), "a.safetensors", &cpn(1), Some(&bundle(OURS, &cpn(1))));
        write(folder.path(), "b.safetensors", &cpn(2), wrong.as_deref());
        let error = no_start(folder.path(), Some(Trust::Enforce), trusted_keys.clone()).await;
        let expected = format!("checkpoint {}: {reason}", folder.path().join("b.safetensors").display());
        assert!(error.starts_with(&expected), "expected {expected}…, got {error}");

        // Otherwise it is only warned of, and without keys not even that.
        for (trust, keys) in [
            (Some(Trust::Warn), &trusted_keys[..]),
            (None, &trusted_keys),
            (Some(Trust::Off), &trusted_keys),
            (None, &[]),
            (Some(Trust::Off), &[]),
        ] {
            let fixture = Fixture::start(&[], |config| {
                config.models_dir = folder.path().into();
                (config.trust, config.trusted_keys) = (trust, keys.to_vec());
            })
            .await;
            let [client, ..] = fixture.clients();
            for (model, seed) in [("a", 1), ("b", 2)] {
                assert_eq!(client.digest(model).await, cpn::checkpoint::digest(&cpn(seed)), "{trust:?}");
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_settings_are_named() {
    let folder = TempDir::new().unwrap();
    for trust in [Trust::Warn, Trust::Enforce] {
        let error = no_start(folder.path(), Some(trust), Vec::new()).await;
        assert_eq!(error, "trusted_keys: expected a key or more, as trust is on, got none");
    }
    let path = folder.path().join("keys.pem");
    let error = no_start(folder.path(), None, vec![path.clone()]).await;
    assert!(error.starts_with(&format!("trusted_keys: {}: No such file", path.display())), "{error}");
    std::fs::write(&path, "no key").unwrap();
    let error = no_start(folder.path(), Some(Trust::Off), vec![path]).await;
    assert!(error.ends_with("public key: expected ECDSA keys on P-256 or P-384, in PEM, got none"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn loaded_checkpoints_are_verified() {
    let keys = TempDir::new().unwrap();
    let fixture = start(Some(Trust::Enforce), &keys).await;
    let folder = fixture.models_dir.path();
    for (seed, client) in (10..).zip(fixture.clients()) {
        let (bytes, transport) = (cpn(seed), client.transport());
        let before = client.list_models().await.unwrap();
        for (index, (wrong, reason)) in wrong_bundles(&bytes).into_iter().enumerate() {
            let file = format!("{seed}-{index}.safetensors");
            write(folder, &file, &bytes, wrong.as_deref());
            for model in ["cpn", "new"] {
                let error = client.load_model(from_file(model, &file)).await.unwrap_err();
                assert_eq!((error.code, error.field.as_str()), (Code::FailedPrecondition, "signature"), "{transport}");
                assert!(error.to_string().starts_with(reason), "{transport}: {error}");
            }
        }
        // Bytes come without a signature.
        let error = client.load_model(from_bytes("cpn", bytes.clone())).await.unwrap_err();
        assert_eq!(error.to_string(), "signature: expected a bundle for cpn.safetensors, got none", "{transport}");
        assert_eq!(client.list_models().await.unwrap(), before, "{transport}");

        let file = format!("{seed}.safetensors");
        write(folder, &file, &bytes, Some(&bundle(OURS, &bytes)));
        let info = client.load_model(from_file("cpn", &file)).await.unwrap().model;
        assert_eq!(info.digest, cpn::checkpoint::digest(&bytes));
        assert_eq!(client.digest("cpn").await, info.digest, "{transport}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn unverified_loaded_checkpoints_are_served_with_a_warning() {
    let keys = TempDir::new().unwrap();
    let fixture = start(None, &keys).await;
    let [client, ..] = fixture.clients();
    write(fixture.models_dir.path(), "2.safetensors", &cpn(2), Some(&bundle(STRANGER, &cpn(2))));
    for (request, seed) in [(from_file("cpn", "2.safetensors"), 2), (from_bytes("cpn", cpn(3)), 3)] {
        client.load_model(request).await.unwrap();
        assert_eq!(client.digest("cpn").await, cpn::checkpoint::digest(&cpn(seed)));
    }
}

/// Serves the chunks of one checkpoint for any digest, and counts the requests.
async fn publish(session: &Session, bytes: Vec<u8>) -> (Queryable<()>, Arc<AtomicUsize>) {
    let runtime = tokio::runtime::Handle::current();
    let asked = Arc::new(AtomicUsize::new(0));
    let (bytes, count) = (Arc::new(bytes), Arc::clone(&asked));
    let queryable = session.declare_queryable(key::checkpoint_chunk("*").unwrap()).complete(true);
    let queryable = queryable.callback(move |query| {
        count.fetch_add(1, Ordering::Relaxed);
        let bytes = Arc::clone(&bytes);
        runtime.spawn(async move {
            let chunk = query::request(&query).map(|request: CheckpointChunkRequest| {
                let start = request.offset_bytes as usize;
                CheckpointChunkResponse { data: bytes[start..start + request.length_bytes as usize].to_vec() }
            });
            query::reply(&query, chunk).unwrap();
        });
    });
    (queryable.await.unwrap(), asked)
}

fn manifest(model: &str, version: u32, bytes: &[u8], signature_bundle: Option<String>) -> CheckpointManifest {
    let loaded = cpn::checkpoint::from_bytes(bytes).unwrap();
    CheckpointManifest {
        model: model.into(),
        version,
        parents: loaded.parents(),
        digest: loaded.digest,
        size_bytes: bytes.len() as u64,
        config_digest: loaded.config_digest,
        signature_bundle,
    }
}

async fn announce(session: &Session, manifest: CheckpointManifest) {
    let key = key::checkpoint_announcement(&manifest.model).unwrap();
    let promoted_unix_nanos = manifest.version.into();
    session.put(key, wire::encode(CheckpointAnnouncement { manifest, promoted_unix_nanos })).await.unwrap();
}

/// Waits until the planner serves a version of a model.
async fn served(client: &Client, model: &str, version: u32) {
    let poll = async {
        loop {
            let models = client.list_models().await.unwrap().models;
            if models.iter().any(|info| (info.name.as_str(), info.version) == (model, version)) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    soon(poll).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn announced_checkpoints_are_verified_before_they_are_fetched() {
    let keys = TempDir::new().unwrap();
    let fixture = start(Some(Trust::Enforce), &keys).await;
    let [client, ..] = fixture.clients();
    let before = client.list_models().await.unwrap();
    let bytes = cpn(2);
    let (_publisher, asked) = publish(&fixture.session, bytes.clone()).await;
    for (wrong, _) in wrong_bundles(&bytes) {
        announce(&fixture.session, manifest("cpn", 2, &bytes, wrong)).await;
    }
    // Announcements are processed in order: once this one is served, the others were processed.
    let good = bundle(OURS, &bytes);
    announce(&fixture.session, manifest("marker", 1, &bytes, Some(good.clone()))).await;
    served(&client, "marker", 1).await;
    assert_eq!(asked.load(Ordering::Relaxed), 1, "by the marker only");
    let mut after = client.list_models().await.unwrap();
    after.models.retain(|info| info.name != "marker");
    assert_eq!(after, before);

    // The refused version is served once its signature is announced.
    announce(&fixture.session, manifest("cpn", 2, &bytes, Some(good))).await;
    served(&client, "cpn", 2).await;
    assert_eq!(client.digest("cpn").await, cpn::checkpoint::digest(&bytes));

    // A valid signature of other bytes is refused.
    let lie = manifest("cpn", 3, &cpn(3), Some(bundle(OURS, &cpn(3))));
    announce(&fixture.session, lie).await;
    announce(&fixture.session, manifest("marker", 2, &bytes, Some(bundle(OURS, &bytes)))).await;
    served(&client, "marker", 2).await;
    assert_eq!(client.digest("cpn").await, cpn::checkpoint::digest(&bytes));
}

#[tokio::test(flavor = "multi_thread")]
async fn unverified_announced_checkpoints_are_served_with_a_warning() {
    let keys = TempDir::new().unwrap();
    for trust in [Trust::Warn, Trust::Off] {
        let fixture = start(Some(trust), &keys).await;
        let [client, ..] = fixture.clients();
        let (_publisher, _) = publish(&fixture.session, cpn(2)).await;
        announce(&fixture.session, manifest("cpn", 2, &cpn(2), None)).await;
        served(&client, "cpn", 2).await;
        announce(&fixture.session, manifest("other", 4, &cpn(2), Some(bundle(STRANGER, &cpn(2))))).await;
        served(&client, "other", 4).await;
    }
}
