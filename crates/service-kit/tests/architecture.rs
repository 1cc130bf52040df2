//! The direction of dependencies: services know the libraries; of these, only recordings know another, the messages.

#![expect(clippy::unwrap_used, reason = "a test")]

use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

/// The names of the dependencies of each crate of the workspace, but for those of tests.
fn dependencies() -> BTreeMap<String, BTreeSet<String>> {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--offline", "--format-version", "1"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    let metadata: Value = serde_json::from_slice(&output.stdout).unwrap();
    let text = |value: &Value| value.as_str().unwrap().to_owned();
    let of = |package: &Value| {
        let all = package["dependencies"].as_array().unwrap().iter();
        all.filter(|dependency| dependency["kind"] != "dev").map(|dependency| text(&dependency["name"])).collect()
    };
    metadata["packages"].as_array().unwrap().iter().map(|package| (text(&package["name"]), of(package))).collect()
}

#[test]
fn each_crate_knows_only_what_it_may() {
    let allowed: BTreeMap<&str, &[&str]> = BTreeMap::from([
        ("cpn", &[][..]),
        ("wire", &[]),
        ("service-kit", &[]),
        ("recording", &["wire"]),
        ("signing", &[]),
        ("certs", &["service-kit", "wire"]),
        ("planner", &["cpn", "signing", "wire", "service-kit"]),
        ("trainer", &["cpn", "recording", "signing", "wire", "service-kit"]),
        ("evaluator", &["recording", "wire", "service-kit"]),
    ]);
    let dependencies = dependencies();
    assert_eq!(
        dependencies.keys().map(String::as_str).collect::<Vec<_>>(),
        allowed.keys().copied().collect::<Vec<_>>()
    );
    for (name, known) in &dependencies {
        let ours: BTreeSet<_> = known.iter().map(String::as_str).filter(|k| allowed.contains_key(k)).collect();
        assert_eq!(ours, allowed[name.as_str()].iter().copied().collect(), "{name}");
    }
}

#[test]
fn the_method_knows_no_network_and_messages_no_tensors() {
    let dependencies = dependencies();
    let knows = |name: &str, others: &[&str]| others.iter().any(|other| dependencies[name].contains(*other));
    assert!(!knows("cpn", &["tokio", "zenoh", "tonic", "prost", "tracing"]));
    assert!(!knows("wire", &["tch", "tokio"]));
    assert!(!knows("signing", &["tch", "tokio", "tracing"]));
    assert!(!knows("recording", &["tch", "tokio", "zenoh"]));
    assert!(!knows("evaluator", &["tch"]));
}
