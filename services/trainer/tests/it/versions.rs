//! Versions of a model, through restarts and damage.

use crate::common::{self, checkpoint};
use cpn::archive::{self, Tensor, Tensors};
use std::collections::BTreeSet;
use std::num::NonZeroU16;
use std::path::Path;
use tempfile::TempDir;
use testing::signatures::bundle;
use trainer::publish::versions::Versions;
use wire::checkpoint::{
    CheckpointAnnouncement, CheckpointChunkRequest, CheckpointManifest, ListVersionsRequest, PromoteVersionRequest,
    RollBackRequest,
};
use wire::{Code, Error};

fn open(folder: &TempDir, keep: u16) -> Versions {
    Versions::open(folder.path().to_owned(), NonZeroU16::new(keep).unwrap()).unwrap()
}

/// Version numbers of the model "cpn", and the promoted one.
fn listed(versions: &Versions) -> (Vec<u32>, u32) {
    let listed = versions.list(ListVersionsRequest { model: Some("cpn".into()) }).unwrap().versions;
    let promoted: Vec<_> = listed.iter().filter(|version| version.promoted).collect();
    assert_eq!(promoted.len(), 1);
    (listed.iter().map(|version| version.manifest.version).collect(), promoted[0].manifest.version)
}

fn promote(versions: &Versions, version: u32) -> Result<CheckpointManifest, Error> {
    versions.promote(PromoteVersionRequest { model: "cpn".into(), version }).map(|response| response.manifest)
}

fn roll_back(versions: &Versions) -> Result<u32, Error> {
    versions.roll_back(RollBackRequest { model: "cpn".into() }).map(|response| response.manifest.version)
}

fn announced(versions: &Versions) -> CheckpointAnnouncement {
    versions.promoted().borrow()["cpn"].clone()
}

/// Bytes of a version, fetched in chunks.
fn fetched(versions: &Versions, manifest: &CheckpointManifest) -> Vec<u8> {
    let mut bytes = Vec::new();
    while (bytes.len() as u64) < manifest.size_bytes {
        let (digest, offset_bytes) = (manifest.digest.clone(), bytes.len() as u64);
        let request = CheckpointChunkRequest { digest, offset_bytes, length_bytes: 1000 };
        bytes.extend(versions.chunk(request).unwrap().data);
    }
    bytes
}

/// Names of the files of the model "cpn".
fn files(folder: &TempDir) -> BTreeSet<String> {
    let entries = std::fs::read_dir(folder.path().join("versions/cpn")).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

fn weights(seeds: &[u64]) -> BTreeSet<String> {
    let digests = seeds.iter().map(|&seed| cpn::checkpoint::digest(&checkpoint(seed)));
    digests.map(|digest| format!("{digest}.safetensors")).chain(["history.json".into()]).collect()
}

#[test]
fn a_checkpoint_becomes_the_next_version_and_is_promoted() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    assert_eq!(versions.promoted().borrow().len(), 0);
    for (number, seed) in [(1, 1), (2, 2), (3, 1)] {
        let bytes = checkpoint(seed);
        versions.publish("cpn", &bytes).unwrap();
        // The same checkpoint again is no new version.
        versions.publish("cpn", &bytes).unwrap();

        let loaded = cpn::checkpoint::from_bytes(&bytes).unwrap();
        let manifest = CheckpointManifest {
            model: "cpn".into(),
            version: number,
            digest: loaded.digest,
            size_bytes: bytes.len() as u64,
            config_digest: loaded.config_digest,
            parents: vec![common::DATA_DIGEST.into()],
            signature_bundle: None,
        };
        assert_eq!(announced(&versions).manifest, manifest);
        assert_eq!(listed(&versions), ((1..=number).collect(), number));
        assert_eq!(fetched(&versions, &manifest), bytes);
    }

    versions.publish("other", &checkpoint(4)).unwrap();
    let all = versions.list(ListVersionsRequest { model: None }).unwrap().versions;
    let all: Vec<_> = all.iter().map(|version| (version.manifest.model.as_str(), version.manifest.version)).collect();
    assert_eq!(all, [("cpn", 1), ("cpn", 2), ("cpn", 3), ("other", 1)]);
}

#[test]
fn versions_are_promoted_and_rolled_back() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    for seed in 1..=3 {
        versions.publish("cpn", &checkpoint(seed)).unwrap();
    }
    let mut promoted_unix_nanos = announced(&versions).promoted_unix_nanos;
    let mut later = || {
        let before = std::mem::replace(&mut promoted_unix_nanos, announced(&versions).promoted_unix_nanos);
        assert!(promoted_unix_nanos > before, "whatever is promoted now holds");
    };
    assert_eq!(roll_back(&versions).unwrap(), 2);
    later();
    assert_eq!(promote(&versions, 1).unwrap().version, 1);
    later();
    assert_eq!(listed(&versions), (vec![1, 2, 3], 1));
    assert_eq!(announced(&versions).manifest.version, 1);
    assert_eq!(roll_back(&versions).unwrap(), 2);
    later();
    let error = roll_back(&versions).unwrap_err();
    assert_eq!((error.code, error.field.as_str()), (Code::FailedPrecondition, "model"), "3 was rolled back, 1 was too");
    assert_eq!(listed(&versions), (vec![1, 2, 3], 2));
}

#[test]
fn unknown_models_and_versions_are_named() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    versions.publish("cpn", &checkpoint(1)).unwrap();
    let before = announced(&versions);

    let model = || "gpt".to_owned();
    let errors = [
        (promote(&versions, 2).unwrap_err(), Error::new(Code::NotFound, "version", "one of [1]", 2)),
        (
            versions.promote(PromoteVersionRequest { model: model(), version: 1 }).unwrap_err(),
            Error::new(Code::NotFound, "model", "one of cpn", "gpt"),
        ),
        (
            versions.roll_back(RollBackRequest { model: model() }).unwrap_err(),
            Error::new(Code::NotFound, "model", "one of cpn", "gpt"),
        ),
        (
            versions.list(ListVersionsRequest { model: Some(model()) }).unwrap_err(),
            Error::new(Code::NotFound, "model", "one of cpn", "gpt"),
        ),
    ];
    for (error, expected) in errors {
        assert_eq!(error, expected);
    }

    let chunk = |digest: &str, offset_bytes| {
        let request = CheckpointChunkRequest { digest: digest.into(), offset_bytes, length_bytes: 7 };
        versions.chunk(request).unwrap_err()
    };
    let CheckpointManifest { digest, size_bytes, .. } = &before.manifest;
    assert_eq!(chunk(&"0".repeat(64), 0).field, "digest");
    assert_eq!(chunk(digest, *size_bytes).field, "offset_bytes");
    assert_eq!(announced(&versions), before);
}

#[test]
fn the_last_versions_are_kept() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 2);
    for seed in 1..=4 {
        versions.publish("cpn", &checkpoint(seed)).unwrap();
    }
    assert_eq!(listed(&versions), (vec![3, 4], 4));
    assert_eq!(files(&folder), weights(&[3, 4]));
    promote(&versions, 3).unwrap();
    drop(versions);
    // With a lower limit than there are versions, the promoted one is still kept.
    let versions = open(&folder, 1);
    assert_eq!(listed(&versions), (vec![3, 4], 3));
    versions.publish("cpn", &checkpoint(5)).unwrap();
    assert_eq!(listed(&versions), (vec![5], 5));
    assert_eq!(files(&folder), weights(&[5]));
    assert_eq!(roll_back(&versions).unwrap_err().code, Code::FailedPrecondition, "there is nothing left to go back to");
}

#[test]
fn two_versions_may_have_the_same_weights() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 2);
    for seed in [1, 2, 1] {
        versions.publish("cpn", &checkpoint(seed)).unwrap();
    }
    assert_eq!(listed(&versions), (vec![2, 3], 3));
    assert_eq!(fetched(&versions, &announced(&versions).manifest), checkpoint(1));
}

#[test]
fn a_restart_changes_nothing() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    std::fs::write(folder.path().join("cpn.safetensors"), checkpoint(3)).unwrap();
    for seed in 1..=2 {
        versions.publish("cpn", &checkpoint(seed)).unwrap();
    }
    versions.take_in().unwrap();
    roll_back(&versions).unwrap();
    let (before, listed_before) = (announced(&versions), listed(&versions));
    assert_eq!(listed_before, (vec![1, 2, 3], 2));
    let error = Versions::open(folder.path().to_owned(), NonZeroU16::MIN).unwrap_err();
    assert!(format!("{error:#}").contains("expected one that no process keeps"), "{error:#}");
    drop(versions);

    // Files of a process that was killed before it wrote the history.
    let kept = folder.path().join("versions/cpn");
    for name in [".unfinished-1", &format!("{}.safetensors", "0".repeat(64))] {
        std::fs::write(kept.join(name), b"half").unwrap();
    }
    std::fs::create_dir(folder.path().join("versions/begun")).unwrap();
    let versions = open(&folder, 5);
    assert_eq!(files(&folder), weights(&[1, 2, 3]));
    assert_eq!((announced(&versions), listed(&versions)), (before.clone(), listed_before.clone()));
    // The checkpoint that was rolled back from is still in the folder.
    versions.take_in().unwrap();
    assert_eq!((announced(&versions), listed(&versions)), (before, listed_before));
    versions.publish("cpn", &checkpoint(4)).unwrap();
    assert_eq!(listed(&versions), (vec![1, 2, 3, 4], 4));
    assert_eq!(roll_back(&versions).unwrap(), 2, "what was promoted when is known still");
}

/// Promotion times increase even if the clock is set back.
#[test]
fn promotion_times_increase_when_the_clock_is_set_back() {
    let folder = TempDir::new().unwrap();
    open(&folder, 5).publish("cpn", &checkpoint(1)).unwrap();
    let path = folder.path().join("versions/cpn/history.json");
    let mut history: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    let ahead = history["promoted_unix_nanos"].as_u64().unwrap() + 3_600_000_000_000;
    history["promoted_unix_nanos"] = ahead.into();
    std::fs::write(&path, history.to_string()).unwrap();
    let versions = open(&folder, 5);
    promote(&versions, 1).unwrap();
    assert_eq!(announced(&versions).promoted_unix_nanos, ahead + 1);
}

#[test]
fn damaged_versions_are_dropped() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    for seed in 1..=3 {
        versions.publish("cpn", &checkpoint(seed)).unwrap();
    }
    let before = announced(&versions);
    drop(versions);
    let path = |seed: u64| {
        let digest = cpn::checkpoint::digest(&checkpoint(seed));
        folder.path().join(format!("versions/cpn/{digest}.safetensors"))
    };
    let mut bytes = checkpoint(3);
    bytes[200] ^= 1;
    std::fs::write(path(3), bytes).unwrap();
    std::fs::remove_file(path(1)).unwrap();
    let versions = open(&folder, 5);
    assert_eq!(listed(&versions), (vec![2], 2));
    assert!(announced(&versions).promoted_unix_nanos > before.promoted_unix_nanos, "planners must go back");
    versions.publish("cpn", &checkpoint(4)).unwrap();
    assert_eq!(roll_back(&versions).unwrap(), 2);
    drop(versions);

    // No version that was promoted and not rolled back is left.
    std::fs::remove_file(path(2)).unwrap();
    let versions = open(&folder, 5);
    assert_eq!(listed(&versions), (vec![3], 3));
    assert_eq!(fetched(&versions, &announced(&versions).manifest), checkpoint(4));
    drop(versions);

    std::fs::write(folder.path().join("versions/cpn/history.json"), b"{").unwrap();
    let error = format!("{:#}", Versions::open(folder.path().to_owned(), NonZeroU16::MIN).unwrap_err());
    assert!(error.contains("versions/cpn: history.json: EOF"), "{error}");
}

/// Listed versions have their weights on disk, also if files change while the process runs.
#[test]
fn missing_weights_are_not_promoted_and_can_be_restored() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    for seed in 1..=2 {
        versions.publish("cpn", &checkpoint(seed)).unwrap();
    }
    let path = |seed: u64| {
        let digest = cpn::checkpoint::digest(&checkpoint(seed));
        folder.path().join(format!("versions/cpn/{digest}.safetensors"))
    };
    let before = announced(&versions);
    let mut damaged = checkpoint(1);
    damaged[200] ^= 1;
    std::fs::write(path(1), damaged).unwrap();
    for refused in [promote(&versions, 1).map(drop), roll_back(&versions).map(drop)] {
        let error = refused.unwrap_err();
        assert_eq!((error.code, error.field.as_str()), (Code::FailedPrecondition, "version"));
        assert!(error.got.contains(&path(1).display().to_string()), "{error}");
    }
    std::fs::remove_file(path(1)).unwrap();
    assert_eq!((announced(&versions), listed(&versions)), (before.clone(), (vec![2], 2)));

    std::fs::remove_file(path(2)).unwrap();
    versions.publish("cpn", &checkpoint(2)).unwrap();
    assert_eq!(fetched(&versions, &before.manifest), checkpoint(2));
}

#[test]
fn hidden_files_are_ignored() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    std::fs::write(folder.path().join("._cpn.safetensors"), checkpoint(1)).unwrap();
    std::fs::create_dir(folder.path().join("lost+found")).unwrap();
    versions.take_in().unwrap();
    assert!(versions.promoted().borrow().is_empty());
    drop(versions);
    let trash = folder.path().join("versions/.Trash-1000");
    std::fs::create_dir(&trash).unwrap();
    std::fs::write(trash.join("history.json"), "{").unwrap();
    open(&folder, 5);
}

#[test]
fn faulty_checkpoints_are_refused_without_traces() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    let good = checkpoint(1);

    let (mut tensors, mut metadata): (Tensors, serde_json::Value) = archive::from_bytes(&good).unwrap();
    metadata["model"]["hidden"] = 9.into();
    let mismatched = archive::to_bytes(&tensors, &metadata).unwrap();
    metadata["model"]["hidden"] = 5.into();
    tensors.insert("network.trunk.bias".into(), Tensor::new(&[], &[f32::NAN]));
    let misshapen = archive::to_bytes(&tensors, &metadata).unwrap();

    for (bytes, reason) in [
        (&good[..good.len() - 1], "safetensors"),
        (&[], "safetensors"),
        (&vec![0; cpn::checkpoint::MAX_BYTES + 1], "expected at most 67108864 bytes, got 67108865"),
        (&mismatched, "expected F32["),
        (&misshapen, "\"network.trunk.bias\""),
    ] {
        let error = versions.publish("cpn", bytes).unwrap_err();
        assert_eq!((error.code, error.field.as_str()), (Code::InvalidArgument, "checkpoint"));
        assert!(error.got.contains(reason), "{error}");
    }

    assert_eq!(versions.publish("../cpn", &good).unwrap_err().field, "model");
    assert!(!folder.path().join("versions/cpn").exists() && !folder.path().join("cpn").exists());
    assert!(versions.promoted().borrow().is_empty());
}

/// A rewritten file is read again, and a faulty one does not affect others.
#[test]
fn checkpoints_of_training_runs_are_published() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    let path = |name: &str| folder.path().join(name);
    let write = |name: &str, bytes: &[u8]| service_kit::files::write_atomically(&path(name), bytes).unwrap();
    let versions_of = || -> Vec<_> {
        versions.take_in().unwrap();
        let listed = versions.list(ListVersionsRequest { model: None }).unwrap().versions;
        listed.into_iter().map(|version| (version.manifest.model, version.manifest.version)).collect()
    };
    write("cpn.safetensors", &checkpoint(1)[..100]);
    write("Not A Name.safetensors", &checkpoint(1));
    write("notes.txt", b"not a checkpoint");
    std::fs::create_dir(path("a.safetensors")).unwrap();
    std::os::unix::fs::symlink(Path::new("nowhere"), path("b.safetensors")).unwrap();
    write("upn.safetensors", &checkpoint(2));
    assert_eq!(versions_of(), [("upn".into(), 1)]);
    assert_eq!(versions_of(), [("upn".into(), 1)]);
    write("cpn.safetensors", &checkpoint(1));
    write("upn.safetensors", &checkpoint(3));
    assert_eq!(versions_of(), [("cpn".into(), 1), ("upn".into(), 1), ("upn".into(), 2)]);
}

/// Signature of each version of the model "cpn".
fn signatures(versions: &Versions) -> Vec<Option<String>> {
    let listed = versions.list(ListVersionsRequest { model: Some("cpn".into()) }).unwrap().versions;
    listed.into_iter().map(|version| version.manifest.signature_bundle).collect()
}

/// A signature may be written before its checkpoint, with it or after it.
#[test]
fn a_signature_is_published_with_its_checkpoint() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    let [weights, signature] = ["cpn.safetensors", "cpn.safetensors.sig"].map(|name| folder.path().join(name));
    let write = |path: &Path, bytes: &[u8]| service_kit::files::write_atomically(path, bytes).unwrap();
    let [first, second] = [1, 2].map(|seed| bundle(1, &checkpoint(seed)));

    // After: the version stays, and is announced again with its signature.
    write(&weights, &checkpoint(1));
    versions.take_in().unwrap();
    let mut watched = versions.promoted();
    let before = watched.borrow_and_update()["cpn"].clone();
    assert_eq!(before.manifest.signature_bundle, None);
    versions.take_in().unwrap();
    assert!(!watched.has_changed().unwrap());
    write(&signature, first.as_bytes());
    versions.take_in().unwrap();
    let expected = CheckpointManifest { signature_bundle: Some(first.clone()), ..before.manifest };
    assert!(watched.has_changed().unwrap());
    assert_eq!(watched.borrow_and_update()["cpn"], CheckpointAnnouncement { manifest: expected, ..before });
    versions.take_in().unwrap();
    assert!(!watched.has_changed().unwrap(), "it is nothing new");

    // Before: a signature of other weights is ignored until those are there.
    write(&signature, second.as_bytes());
    versions.take_in().unwrap();
    assert_eq!(signatures(&versions), [Some(first.clone())]);
    write(&weights, &checkpoint(2));
    versions.take_in().unwrap();
    assert_eq!(signatures(&versions), [Some(first.clone()), Some(second.clone())]);
    // The signature of the previous weights.
    write(&weights, &checkpoint(3));
    versions.take_in().unwrap();
    assert_eq!(signatures(&versions), [Some(first.clone()), Some(second.clone()), None]);

    // Another key's signature replaces it; the version keeps it without the file, and through a restart.
    let third = bundle(2, &checkpoint(3));
    for bundle in [bundle(1, &checkpoint(3)), third.clone()] {
        write(&signature, bundle.as_bytes());
        versions.take_in().unwrap();
        assert_eq!(signatures(&versions)[2].as_ref(), Some(&bundle));
    }
    std::fs::remove_file(&signature).unwrap();
    versions.take_in().unwrap();
    let announced_before = announced(&versions);
    drop(versions);
    let versions = open(&folder, 5);
    versions.take_in().unwrap();
    assert_eq!(signatures(&versions), [Some(first), Some(second), Some(third)]);
    assert_eq!(announced(&versions), announced_before);
}

/// A version that was rolled back from gets its signature, and is not promoted by it.
#[test]
fn a_signature_promotes_nothing() {
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    let path = folder.path().join("cpn.safetensors");
    for seed in [1, 2, 1] {
        std::fs::write(&path, checkpoint(seed)).unwrap();
        versions.take_in().unwrap();
    }
    roll_back(&versions).unwrap();
    let before = announced(&versions);
    let first = bundle(1, &checkpoint(1));
    std::fs::write(folder.path().join("cpn.safetensors.sig"), &first).unwrap();
    versions.take_in().unwrap();
    assert_eq!(signatures(&versions), [Some(first.clone()), None, Some(first)], "both have these weights");
    assert_eq!(announced(&versions), before);
    assert_eq!(listed(&versions), (vec![1, 2, 3], 2));
}

#[test]
fn signatures_of_other_weights_are_ignored() {
    let good = bundle(1, &checkpoint(1));
    let other = bundle(1, &checkpoint(2));
    for wrong in ["", "{}", "null", &good[..good.len() - 1], &other, &" ".repeat(70_000)] {
        let folder = TempDir::new().unwrap();
        let versions = open(&folder, 5);
        std::fs::write(folder.path().join("cpn.safetensors.sig"), wrong).unwrap();
        std::fs::write(folder.path().join("cpn.safetensors"), checkpoint(1)).unwrap();
        versions.take_in().unwrap();
        assert_eq!(signatures(&versions), [None], "{wrong:.20}");
    }
    let folder = TempDir::new().unwrap();
    let versions = open(&folder, 5);
    std::fs::create_dir(folder.path().join("cpn.safetensors.sig")).unwrap();
    std::fs::write(folder.path().join("cpn.safetensors"), checkpoint(1)).unwrap();
    versions.take_in().unwrap();
    assert_eq!(signatures(&versions), [None]);
}

/// Histories without signatures are read, and those of unsigned versions have no field that older releases would refuse.
#[test]
fn an_unsigned_history_has_no_signature_fields() {
    let folder = TempDir::new().unwrap();
    open(&folder, 5).publish("cpn", &checkpoint(1)).unwrap();
    let history = std::fs::read_to_string(folder.path().join("versions/cpn/history.json")).unwrap();
    assert!(history.contains("config_digest") && !history.contains("signature"), "{history}");
    assert_eq!(signatures(&open(&folder, 5)), [None]);
}
