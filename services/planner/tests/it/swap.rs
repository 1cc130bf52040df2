//! Swaps of models: between two plans, only for valid checkpoints, and invisible to requests except for the digest.

use crate::common::{Client, Fixture, checkpoint, from_bytes, from_file, is, plan_request, soon};
use cpn::MethodKind;
use cpn::archive::{self, Tensor, Tensors};
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;
use tokio::task::JoinSet;
use wire::checkpoint::{CheckpointAnnouncement, CheckpointChunkRequest, CheckpointChunkResponse, CheckpointManifest};
use wire::proto::PlanRequest;
use wire::{Code, key, query};
use zenoh::Session;
use zenoh::query::Queryable;

fn cpn(seed: u64) -> Vec<u8> {
    checkpoint(MethodKind::Cpn, seed)
}

/// Checkpoint whose contents `spoil` has made invalid.
fn spoiled(spoil: impl FnOnce(&mut Tensors, &mut serde_json::Value)) -> Vec<u8> {
    let (mut tensors, mut metadata) = archive::from_bytes(&cpn(1)).unwrap();
    spoil(&mut tensors, &mut metadata);
    archive::to_bytes(&tensors, &metadata).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_faulty_checkpoint_changes_nothing() {
    let fixture = Fixture::start(&[("cpn", cpn(1))], |_| ()).await;
    let truncated = cpn(2)[..1000].to_vec();
    let wrong_shape = spoiled(|_, metadata| metadata["model"]["hidden"] = 9.into());
    let not_a_number = spoiled(|tensors, _| drop(tensors.insert("step_size".into(), Tensor::new(&[], &[f32::NAN]))));
    // All weights are finite, but the embedding of a white image is not.
    let overflowing = spoiled(|tensors, _| {
        let weight = tensors.iter_mut().find(|(name, _)| name.starts_with("encoder.") && name.ends_with("weight"));
        let weight = weight.unwrap().1;
        let count = weight.shape().iter().product();
        *weight = Tensor::new(weight.shape(), &vec![f32::MAX; count]);
    });
    for client in fixture.clients() {
        let before = client.digest("cpn").await;
        for (checkpoint, reason) in [
            (&truncated, "safetensors"),
            (&wrong_shape, "expected F32["),
            (&not_a_number, "\"step_size\": expected finite values"),
            (&overflowing, "expected finite numbers"),
        ] {
            let error = client.load_model(from_bytes("cpn", checkpoint.clone())).await.unwrap_err();
            assert_eq!((error.code, error.field.as_str()), (wire::Code::InvalidArgument, "checkpoint"));
            assert!(error.got.contains(reason), "{}: {error}", client.transport());
            assert_eq!(client.digest("cpn").await, before);
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_valid_checkpoint_is_served_from_bytes_and_files() {
    let fixture = Fixture::start(&[("cpn", cpn(1))], |_| ()).await;
    for (seed, client) in (10..).zip(fixture.clients()) {
        for (model, seed) in [("cpn", seed), (client.transport().to_lowercase().as_str(), seed + 10)] {
            let digest = cpn::checkpoint::digest(&cpn(seed));
            let info = client.load_model(from_bytes(model, cpn(seed))).await.unwrap().model;
            assert_eq!((info.name.as_str(), &info.digest), (model, &digest));
            assert_eq!(client.digest(model).await, digest, "old name or new");
        }
        let file = fixture.models_dir.path().join("later.safetensors");
        std::fs::write(file, cpn(seed + 20)).unwrap();
        let info = client.load_model(from_file("later", "later.safetensors")).await.unwrap().model;
        assert_eq!(info.digest, cpn::checkpoint::digest(&cpn(seed + 20)));
    }
}

/// The number of names is bounded; unloading one makes room for another.
#[tokio::test(flavor = "multi_thread")]
async fn names_are_bounded_and_can_be_freed() {
    let fixture = Fixture::start(&[("cpn", cpn(1))], |config| config.model_capacity = 3.try_into().unwrap()).await;
    for client in fixture.clients() {
        let refused = |code: Code, error: wire::Error| {
            assert_eq!((error.code, error.field.as_str()), (code, "model"), "{}: {error}", client.transport());
        };
        client.load_model(from_bytes("third", cpn(2))).await.unwrap();
        refused(Code::ResourceExhausted, client.load_model(from_bytes("fourth", cpn(3))).await.unwrap_err());
        client.load_model(from_bytes("third", cpn(3))).await.unwrap();
        client.load_model(from_bytes("cpn", cpn(2))).await.unwrap();

        client.unload_model("third").await.unwrap();
        is(Code::NotFound, "model", client.plan(plan_request("third", 1)).await);
        let names: Vec<_> = client.list_models().await.unwrap().models.into_iter().map(|info| info.name).collect();
        assert_eq!(names, ["cpn", "random"]);
        refused(Code::NotFound, client.unload_model("third").await.unwrap_err());
        refused(Code::FailedPrecondition, client.unload_model("random").await.unwrap_err());
        client.load_model(from_bytes("fourth", cpn(3))).await.unwrap();
        client.unload_model("fourth").await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_folder_with_too_many_models_is_refused() {
    let models_dir = tempfile::TempDir::new().unwrap();
    for name in ["a", "b"] {
        std::fs::write(models_dir.path().join(format!("{name}.safetensors")), cpn(1)).unwrap();
    }
    let config = planner::Config {
        models_dir: models_dir.path().into(),
        model_capacity: 2.try_into().unwrap(),
        grpc_listen: ([127, 0, 0, 1], 0).into(),
        ..planner::Config::default()
    };
    let error = planner::start(config).await.unwrap_err();
    assert_eq!(error.to_string(), "model_capacity: expected room for the 3 models that are there, got 2");
}

/// A link to a file outside the folder is not followed, and the error reveals nothing of the file.
#[tokio::test(flavor = "multi_thread")]
async fn nothing_outside_the_folder_is_opened() {
    let fixture = Fixture::start(&[("cpn", cpn(1))], |_| ()).await;
    let (folder, elsewhere) = (fixture.models_dir.path(), tempfile::TempDir::new().unwrap());
    std::fs::write(elsewhere.path().join("sound.safetensors"), cpn(2)).unwrap();
    std::fs::write(elsewhere.path().join("secret"), "-----BEGIN PRIVATE KEY-----").unwrap();
    for file in ["sound.safetensors", "secret"] {
        std::os::unix::fs::symlink(elsewhere.path().join(file), folder.join(file)).unwrap();
    }
    std::os::unix::fs::symlink(elsewhere.path(), folder.join("folder")).unwrap();
    std::os::unix::fs::symlink("cpn.safetensors", folder.join("inside.safetensors")).unwrap();
    let first = u64::from_le_bytes(*b"-----BEG").to_string();
    for client in fixture.clients() {
        for file in ["sound.safetensors", "secret", "folder"] {
            let error = client.load_model(from_file("cpn", file)).await.unwrap_err();
            assert_eq!((error.code, error.field.as_str()), (Code::InvalidArgument, "file"), "{file}: {error}");
            assert!(error.got.contains("outside the folder") && !error.to_string().contains(&first), "{error}");
        }
        client.load_model(from_file("cpn", "inside.safetensors")).await.unwrap();
    }
}

/// Fifty swaps between two checkpoints while every transport plans: no plan fails, and each is, to the bit, that of the
/// checkpoint it names.
#[tokio::test(flavor = "multi_thread")]
async fn plans_during_swaps_are_of_one_checkpoint_each() {
    let checkpoints = [cpn(1), cpn(2)];
    let fixture = Fixture::start(&[("cpn", checkpoints[0].clone())], |_| ()).await;
    let [swapper, ..] = fixture.clients();
    let request = plan_request("cpn", 5);
    let mut expected = HashMap::new();
    for checkpoint in checkpoints.iter().rev() {
        swapper.load_model(from_bytes("cpn", checkpoint.clone())).await.unwrap();
        let plan = swapper.plan(request.clone()).await.unwrap();
        expected.insert(plan.model_digest, plan.actions);
    }
    assert_eq!(expected.len(), 2);
    let (expected, done) = (Arc::new(expected), Arc::new(AtomicBool::new(false)));
    let mut planning = JoinSet::new();
    for client in fixture.clients() {
        let (request, expected, done) = (request.clone(), Arc::clone(&expected), Arc::clone(&done));
        planning.spawn(async move {
            let mut plans = 0;
            while !done.load(Ordering::Relaxed) || plans == 0 {
                let plan = client.plan(request.clone()).await.unwrap();
                assert_eq!(plan.actions, expected[&plan.model_digest], "{}", client.transport());
                plans += 1;
            }
        });
    }
    for swap in 1..=50 {
        let checkpoint = &checkpoints[swap % 2];
        let info = swapper.load_model(from_bytes("cpn", checkpoint.clone())).await.unwrap().model;
        let plan = swapper.plan(request.clone()).await.unwrap();
        assert_eq!(plan.model_digest, info.digest, "swap {swap}");
    }
    done.store(true, Ordering::Relaxed);
    while let Some(task) = soon(planning.join_next()).await {
        task.unwrap();
    }
}

/// A request with the digest of a retired checkpoint is answered by it, for as long as it is kept.
#[tokio::test(flavor = "multi_thread")]
async fn retired_checkpoints_answer_requests_with_their_digests() {
    let fixture = Fixture::start(&[("cpn", cpn(0))], |config| config.retired_capacity = 2.try_into().unwrap()).await;
    let pinned = |digest: &str| PlanRequest { model_digest: digest.into(), ..plan_request("cpn", 5) };
    let digests = [0, 1, 2, 3, 4].map(|seed| cpn::checkpoint::digest(&cpn(seed)));
    let [swapper, ..] = fixture.clients();
    let first = swapper.plan(plan_request("cpn", 5)).await.unwrap();
    assert_eq!(first.model_digest, digests[0]);
    for swap in 1..=3 {
        swapper.load_model(from_bytes("cpn", cpn(swap))).await.unwrap();
        for client in fixture.clients() {
            let plan = client.plan(pinned(&digests[0])).await.unwrap();
            assert_eq!((&plan.model_digest, &plan.actions), (&digests[0], &first.actions), "{}", client.transport());
            assert_eq!(client.digest("cpn").await, digests[swap as usize]);
        }
    }
    // Never requested, hence evicted first.
    is(Code::FailedPrecondition, "model_digest", swapper.plan(pinned(&digests[1])).await);
    swapper.load_model(from_bytes("cpn", cpn(4))).await.unwrap();
    swapper.load_model(from_bytes("cpn", cpn(2))).await.unwrap();
    for client in fixture.clients() {
        is(Code::FailedPrecondition, "model_digest", client.plan(pinned(&digests[0])).await);
        let elsewhere = PlanRequest { model: "random".into(), ..pinned(&digests[2]) };
        is(Code::FailedPrecondition, "model_digest", client.plan(elsewhere).await);
        for digest in &digests[2..] {
            assert_eq!(client.plan(pinned(digest)).await.unwrap().model_digest, *digest);
        }
    }
}

/// Serves bytes at digests, which need not be their own.
async fn publish<const N: usize>(session: &Session, bytes: [(&str, &[u8]); N]) -> Queryable<()> {
    let runtime = tokio::runtime::Handle::current();
    let bytes: HashMap<_, _> = bytes.into_iter().map(|(digest, bytes)| (digest.to_owned(), bytes.to_vec())).collect();
    let bytes = Arc::new(bytes);
    session
        .declare_queryable(key::checkpoint_chunk("*").unwrap())
        .complete(true)
        .callback(move |query| {
            let bytes = Arc::clone(&bytes);
            runtime.spawn(async move {
                let chunk = query::request(&query).map(|request: CheckpointChunkRequest| {
                    let bytes = &bytes[&request.digest];
                    let start = bytes.len().min(request.offset_bytes as usize);
                    let end = bytes.len().min(start + request.length_bytes as usize);
                    CheckpointChunkResponse { data: bytes[start..end].to_vec() }
                });
                query::reply(&query, chunk).unwrap();
            });
        })
        .await
        .unwrap()
}

/// Manifest of a checkpoint.
fn manifest(model: &str, version: u32, bytes: &[u8]) -> CheckpointManifest {
    let loaded = cpn::checkpoint::from_bytes(bytes).unwrap();
    CheckpointManifest {
        model: model.into(),
        version,
        parents: loaded.parents(),
        digest: loaded.digest,
        size_bytes: bytes.len() as u64,
        config_digest: loaded.config_digest,
        signature_bundle: None,
    }
}

async fn announce(session: &Session, manifest: CheckpointManifest, promoted_unix_nanos: u64) {
    let key = key::checkpoint_announcement(&manifest.model).unwrap();
    session.put(key, wire::encode(CheckpointAnnouncement { manifest, promoted_unix_nanos })).await.unwrap();
}

/// Waits until the planner serves the checkpoint of a manifest.
async fn served(client: &Client, CheckpointManifest { model, version, digest, .. }: &CheckpointManifest) {
    let poll = async {
        loop {
            let models = client.list_models().await.unwrap().models;
            if models.iter().any(|info| (&info.name, &info.version, &info.digest) == (model, version, digest)) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    soon(poll).await;
}

/// Waits until the planner has processed all earlier announcements.
async fn all_announcements_processed(fixture: &Fixture, client: &Client, bytes: &[u8]) {
    static MARKERS: AtomicU32 = AtomicU32::new(1);
    let marker = manifest("marker", MARKERS.fetch_add(1, Ordering::Relaxed), bytes);
    announce(&fixture.session, marker.clone(), marker.version.into()).await;
    served(client, &marker).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_announced_checkpoint_is_fetched() {
    let fixture = Fixture::start(&[("cpn", cpn(1))], |_| ()).await;
    let [client, ..] = fixture.clients();
    // Larger than one chunk.
    let large = cpn::Model::new(cpn::ModelConfig::paper(MethodKind::TeBc), 4);
    let provenance = cpn::checkpoint::Provenance {
        training_tasks: vec![],
        data_digest: "d".repeat(64),
        render_spec: String::new(),
        seed: 4,
        training: cpn::Training::paper(),
    };
    let bytes = cpn::checkpoint::to_bytes(&large, &provenance).unwrap();
    assert!(bytes.len() > 2 * wire::checkpoint::MAX_CHUNK_BYTES as usize);
    let manifest = manifest("cpn", 3, &bytes);
    let _publisher = publish(&fixture.session, [(&manifest.digest, &bytes)]).await;
    announce(&fixture.session, manifest.clone(), 1).await;
    served(&client, &manifest).await;
    assert_eq!(client.digest("cpn").await, manifest.digest);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_checkpoint_that_differs_from_its_announcement_is_refused() {
    let fixture = Fixture::start(&[("cpn", cpn(1))], |_| ()).await;
    let [client, ..] = fixture.clients();
    let before = client.list_models().await.unwrap();
    let bytes = cpn(2);
    let good = manifest("cpn", 1, &bytes);
    let (size_bytes, other) = (good.size_bytes, cpn::checkpoint::digest(b"something else"));
    let _publisher = publish(&fixture.session, [(&good.digest, &bytes), (&other, &bytes)]).await;
    for manifest in [
        CheckpointManifest { digest: other.clone(), ..good.clone() },
        CheckpointManifest { config_digest: other, ..good.clone() },
        CheckpointManifest { size_bytes: size_bytes + 1, ..good.clone() },
        CheckpointManifest { size_bytes: size_bytes - 1, ..good.clone() },
        CheckpointManifest { size_bytes: u64::MAX, ..good.clone() },
        CheckpointManifest { model: "random".into(), ..good.clone() },
    ] {
        announce(&fixture.session, manifest, 9).await;
    }
    let noise = vec![0xff; 7];
    fixture.session.put(key::checkpoint_announcement("cpn").unwrap(), noise).await.unwrap();
    all_announcements_processed(&fixture, &client, &bytes).await;
    let mut after = client.list_models().await.unwrap();
    after.models.retain(|info| info.name != "marker");
    assert_eq!(after, before);
    // A refused announcement does not suppress an earlier promotion.
    announce(&fixture.session, good.clone(), 1).await;
    served(&client, &good).await;
}

/// Bytes that do not match a valid manifest are refused.
#[tokio::test(flavor = "multi_thread")]
async fn corrupt_and_truncated_chunks_are_refused() {
    let bytes = cpn(2);
    let mut corrupt = bytes.clone();
    corrupt[bytes.len() / 2] ^= 1;
    let mut longer = bytes.clone();
    longer.push(0);
    let faulty = spoiled(|tensors, _| drop(tensors.remove("step_size")));
    let missing = CheckpointManifest {
        digest: cpn::checkpoint::digest(&faulty),
        size_bytes: faulty.len() as u64,
        ..manifest("cpn", 1, &bytes)
    };
    for (manifest, served) in [
        (manifest("cpn", 1, &bytes), corrupt),
        (manifest("cpn", 1, &bytes), bytes[..bytes.len() - 1].to_vec()),
        (manifest("cpn", 1, &bytes), Vec::new()),
        (CheckpointManifest { size_bytes: longer.len() as u64, ..manifest("cpn", 1, &bytes) }, longer),
        (missing, faulty),
    ] {
        let fixture = Fixture::start(&[("cpn", cpn(1))], |_| ()).await;
        let [client, ..] = fixture.clients();
        let before = client.digest("cpn").await;
        let marker = cpn(3);
        let served = [(&*manifest.digest, &*served), (&cpn::checkpoint::digest(&marker), &marker)];
        let _publisher = publish(&fixture.session, served).await;
        announce(&fixture.session, manifest, 1).await;
        all_announcements_processed(&fixture, &client, &marker).await;
        assert_eq!(client.digest("cpn").await, before);
    }
}

/// The version promoted last is served, in whatever order announcements arrive: roll-backs announce older versions, and
/// announcements are repeated and delayed.
#[tokio::test(flavor = "multi_thread")]
async fn the_version_promoted_last_is_served() {
    let fixture = Fixture::start(&[("cpn", cpn(1))], |_| ()).await;
    let [client, ..] = fixture.clients();
    let bytes = cpn(2);
    let _publisher = publish(&fixture.session, [(&cpn::checkpoint::digest(&bytes), &bytes)]).await;
    let version = |number| manifest("cpn", number, &bytes);
    // Announcements with promotion times, and the version served after each.
    for (number, promoted, expected) in
        [(1, 10, 1), (2, 20, 2), (1, 10, 2), (1, 30, 1), (2, 20, 1), (1, 30, 1), (3, 29, 1)]
    {
        announce(&fixture.session, version(number), promoted).await;
        all_announcements_processed(&fixture, &client, &bytes).await;
        served(&client, &version(expected)).await;
    }
    // A model loaded by request stays until another is promoted.
    client.load_model(from_bytes("cpn", cpn(3))).await.unwrap();
    announce(&fixture.session, version(1), 30).await;
    all_announcements_processed(&fixture, &client, &bytes).await;
    assert_eq!(client.digest("cpn").await, cpn::checkpoint::digest(&cpn(3)));
    announce(&fixture.session, version(1), 31).await;
    served(&client, &version(1)).await;
}
