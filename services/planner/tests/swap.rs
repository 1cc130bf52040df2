//! A model is replaced between two plans, by a sound one only, and no request notices more than the digest.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use common::{Client, Fixture, checkpoint, from_bytes, from_file, plan_request, soon};
use cpn::MethodKind;
use cpn::archive::{self, Tensors};
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::task::JoinSet;
use wire::checkpoint::{CheckpointAnnouncement, CheckpointChunkRequest, CheckpointChunkResponse};
use wire::{key, query};
use zenoh::Session;
use zenoh::query::Queryable;

fn cpn(seed: u64) -> Vec<u8> {
    checkpoint(MethodKind::Cpn, seed)
}

/// A checkpoint whose contents `spoil` has made wrong.
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
    let not_a_number = spoiled(|tensors, _| drop(tensors.insert("step_size".into(), f32::NAN.into())));
    // Every weight is finite, the embedding of a white image is not.
    let overflowing = spoiled(|tensors, _| {
        let weight = tensors.iter_mut().find(|(name, _)| name.starts_with("encoder.") && name.ends_with("weight"));
        let _ = weight.unwrap().1.fill_(f64::from(f32::MAX));
    });
    for client in fixture.clients() {
        let before = client.digest("cpn").await;
        for (checkpoint, reason) in [
            (&truncated, "safetensors"),
            (&wrong_shape, "expected Float["),
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
async fn a_sound_checkpoint_is_served_from_bytes_and_files() {
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

/// Two checkpoints change places fifty times while every transport plans: no plan fails, and each is, to the bit, that
/// of the checkpoint it names.
#[tokio::test(flavor = "multi_thread")]
async fn plans_and_swaps_do_not_mix() {
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

/// Serves `bytes` as every checkpoint that is asked for.
async fn publish(session: &Session, bytes: Vec<u8>) -> Queryable<()> {
    let runtime = tokio::runtime::Handle::current();
    let bytes = Arc::new(bytes);
    session
        .declare_queryable(key::checkpoint_chunk("*").unwrap())
        .complete(true)
        .callback(move |query| {
            let bytes = Arc::clone(&bytes);
            runtime.spawn(async move {
                let chunk = query::request(&query).map(|request: CheckpointChunkRequest| {
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

async fn announce(session: &Session, model: &str, digest: String, size_bytes: u64) {
    let announcement = CheckpointAnnouncement { model: model.into(), digest, size_bytes };
    session.put(key::checkpoint_announcement(model).unwrap(), wire::encode(announcement)).await.unwrap();
}

/// Waits until the planner serves a model with this digest.
async fn served(client: &Client, model: &str, digest: &str) {
    let poll = async {
        loop {
            let models = client.list_models().await.unwrap().models;
            if models.iter().any(|info| info.name == model && info.digest == digest) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    soon(poll).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_announced_checkpoint_is_fetched() {
    let fixture = Fixture::start(&[("cpn", cpn(1))], |_| ()).await;
    let [client, ..] = fixture.clients();
    // Larger than one piece.
    let large = cpn::Agent::new(cpn::ModelConfig::paper(MethodKind::TeBc), 4);
    let provenance = cpn::checkpoint::Provenance {
        training_tasks: vec![],
        data_digest: "d".into(),
        render_spec: String::new(),
        seed: 4,
        epochs: 0,
    };
    let bytes = cpn::checkpoint::to_bytes(&large, &provenance).unwrap();
    assert!(bytes.len() > 2 * wire::checkpoint::MAX_CHUNK_BYTES as usize);
    let digest = cpn::checkpoint::digest(&bytes);
    let size = bytes.len() as u64;
    let _publisher = publish(&fixture.session, bytes).await;
    announce(&fixture.session, "cpn", digest.clone(), size).await;
    served(&client, "cpn", &digest).await;
    assert_eq!(client.digest("cpn").await, digest);
}

/// Each false announcement is followed by a true one for another model: once that is served, the false one was refused.
#[tokio::test(flavor = "multi_thread")]
async fn a_checkpoint_that_is_not_what_was_announced_is_refused() {
    let fixture = Fixture::start(&[("cpn", cpn(1))], |_| ()).await;
    let [client, ..] = fixture.clients();
    let before = client.digest("cpn").await;
    let bytes = cpn(2);
    let (digest, size) = (cpn::checkpoint::digest(&bytes), bytes.len() as u64);
    let _publisher = publish(&fixture.session, bytes).await;
    let other = cpn::checkpoint::digest(b"something else");
    announce(&fixture.session, "cpn", other, size).await;
    announce(&fixture.session, "cpn", digest.clone(), size + 1).await;
    announce(&fixture.session, "cpn", digest.clone(), size - 1).await;
    announce(&fixture.session, "cpn", digest.clone(), u64::MAX).await;
    announce(&fixture.session, "random", digest.clone(), size).await;
    let noise = vec![0xff; 7];
    fixture.session.put(key::checkpoint_announcement("cpn").unwrap(), noise).await.unwrap();
    announce(&fixture.session, "honest", digest.clone(), size).await;
    served(&client, "honest", &digest).await;
    assert_eq!(client.digest("cpn").await, before);
}
