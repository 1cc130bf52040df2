//! Checkpoints: round trips, and refusals of damaged files, with the reason.

#![expect(clippy::unwrap_used, reason = "a test")]

use cpn::archive::{self, Tensor, Tensors};
use cpn::checkpoint::{self, Provenance};
use cpn::{MethodKind, Model, ModelConfig};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use testing::{position_config, small_config};

fn provenance() -> Provenance {
    Provenance {
        training_tasks: vec!["door-lock".into()],
        data_digest: "d".into(),
        render_spec: r#"{"camera":"corner"}"#.into(),
        seed: 5,
        training: cpn::Training::paper(),
    }
}

fn saved() -> Vec<u8> {
    checkpoint::to_bytes(&Model::new(small_config(MethodKind::Cpn), 5), &provenance()).unwrap()
}

/// Message of the refusal of a checkpoint after `spoil`.
fn refusal(spoil: impl FnOnce(&mut Tensors, &mut Value)) -> String {
    refusal_of(&saved(), spoil)
}

fn refusal_of(bytes: &[u8], spoil: impl FnOnce(&mut Tensors, &mut Value)) -> String {
    let (mut tensors, mut metadata): (Tensors, Value) = archive::from_bytes(bytes).unwrap();
    spoil(&mut tensors, &mut metadata);
    checkpoint::from_bytes(&archive::to_bytes(&tensors, &metadata).unwrap()).unwrap_err().to_string()
}

#[test]
fn a_checkpoint_round_trips() {
    for config in MethodKind::ALL.into_iter().flat_map(|method| [small_config(method), position_config(method)]) {
        let model = Model::new(config, 5);
        let bytes = checkpoint::to_bytes(&model, &provenance()).unwrap();
        let loaded = checkpoint::from_bytes(&bytes).unwrap();
        assert_eq!(loaded.model, model);
        assert_eq!(loaded.provenance, provenance());
        assert_eq!(checkpoint::to_bytes(&loaded.model, &provenance()).unwrap(), bytes, "same weights, same bytes");
        assert_eq!(loaded.digest, checkpoint::digest(&bytes));
        assert_eq!(loaded.parents(), ["d"]);
    }
}

/// A model with two familiar goals, `[6]` each.
fn with_familiar_goals() -> Model {
    let config = ModelConfig { familiar_goals: 1024, ..small_config(MethodKind::Upn) };
    let mut model = Model::new(config, 5);
    model.set_familiar_goals(&[vec![0.0; 6], vec![1.0; 6]]);
    model
}

#[test]
fn familiar_goals_round_trip_and_others_leave_no_trace() {
    let model = with_familiar_goals();
    assert_eq!(model.config.familiar_goals, 2);
    let bytes = checkpoint::to_bytes(&model, &provenance()).unwrap();
    let loaded = checkpoint::from_bytes(&bytes).unwrap().model;
    assert_eq!(loaded, model);
    assert_eq!(checkpoint::to_bytes(&loaded, &provenance()).unwrap(), bytes);

    let mut of_no_episodes = loaded;
    of_no_episodes.set_familiar_goals(&[]);
    assert_eq!((of_no_episodes.config.familiar_goals, of_no_episodes.familiar), (0, None));

    let (tensors, metadata): (Tensors, Value) = archive::from_bytes(&saved()).unwrap();
    assert!(!tensors.keys().any(|name| name.contains("familiar")) && !metadata.to_string().contains("familiar"));
}

#[test]
fn familiar_goals_that_do_not_fit_the_configuration_are_refused() {
    let bytes = checkpoint::to_bytes(&with_familiar_goals(), &provenance()).unwrap();
    let count = |count: i64| refusal_of(&bytes, |_, metadata| metadata["model"]["familiar_goals"] = json!(count));
    assert_eq!(count(3), "checkpoint tensor \"familiar.goals\": expected F32[3, 6], got F32[2, 6]");
    assert_eq!(count(0), "checkpoint tensor \"familiar.distance\": not part of the model's configuration");
    assert_eq!(count(4097), "checkpoint model: familiar_goals: expected 0 to 4096, got 4097");
    let message = refusal_of(&bytes, |tensors, _| drop(tensors.remove("familiar.distance")));
    assert_eq!(message, "checkpoint tensor \"familiar.distance\": expected by the model's configuration, got none");
    let infinite = Tensor::new(&[], &[f32::INFINITY]);
    let message = refusal_of(&bytes, |tensors, _| drop(tensors.insert("familiar.distance".into(), infinite)));
    assert_eq!(message, "checkpoint tensor \"familiar.distance\": expected finite values, got NaN or infinity");
    let message = refusal_of(&bytes, |_, metadata| {
        let model = &mut metadata["model"];
        (model["method"], model["horizon"], model["updates"]) = (json!("bc"), json!(1), json!(0));
    });
    assert_eq!(message, "checkpoint model: familiar_goals: expected 0 to 0, got 2");
}

#[test]
fn the_configuration_has_a_digest_of_its_own() {
    let config = |model: &Model| {
        checkpoint::from_bytes(&checkpoint::to_bytes(model, &provenance()).unwrap()).unwrap().config_digest
    };
    let (_, metadata): (Tensors, Value) = archive::from_bytes(&saved()).unwrap();
    let model = Model::new(small_config(MethodKind::Cpn), 5);
    let json = serde_json::to_string(&model.config).unwrap();
    assert_eq!(serde_json::from_str::<Value>(&json).unwrap(), metadata["model"]);
    assert_eq!(config(&model), checkpoint::digest(json.as_bytes()));
    assert_eq!(config(&model), config(&Model::new(small_config(MethodKind::Cpn), 6)), "whatever the weights");
    assert_ne!(config(&model), config(&Model::new(small_config(MethodKind::Upn), 5)));
}

#[test]
fn a_truncated_file_is_refused() {
    let bytes = saved();
    for length in [0, 7, 100, bytes.len() - 1] {
        assert!(checkpoint::from_bytes(&bytes[..length]).unwrap_err().to_string().contains("safetensors"));
    }
}

#[test]
fn noise_is_refused() {
    assert!(checkpoint::from_bytes(&[0xff; 4096]).is_err());
}

#[test]
fn an_oversized_file_is_refused() {
    let error = checkpoint::from_bytes(&vec![0; checkpoint::MAX_BYTES + 1]).unwrap_err().to_string();
    assert_eq!(error, "checkpoint: expected at most 67108864 bytes, got 67108865");
}

#[test]
fn an_oversized_header_is_refused_unparsed() {
    let message = refusal(|_, metadata| metadata["provenance"]["render_spec"] = json!("x".repeat(1 << 20)));
    assert!(
        message.starts_with("checkpoint: safetensors: header: expected at most 1048576 bytes, got more"),
        "{message}"
    );
}

/// A checkpoint with the text of its header replaced by `spoil`.
fn with_header(spoil: impl FnOnce(String) -> String) -> String {
    let bytes = saved();
    let length = u64::from_le_bytes(*bytes.first_chunk().unwrap()) as usize;
    let (header, data) = bytes[8..].split_at(length);
    let header = spoil(String::from_utf8(header.to_vec()).unwrap());
    let file = [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), data].concat();
    checkpoint::from_bytes(&file).map_or_else(|error| error.to_string(), |_| "accepted".to_owned())
}

/// Readers differ in which of two duplicates they use, so that duplicates are refused everywhere.
#[test]
fn duplicate_keys_are_refused() {
    assert_eq!(with_header(|header| header), "accepted");
    let tensor = |header: &str| {
        let start = header.find("\"step_size\":").unwrap();
        let end = start + header[start..].find('}').unwrap() + 1;
        header[start..end].to_owned()
    };
    let twice = |header: String, part: &str| header.replacen(part, &format!("{part},{part}"), 1);
    for (refused, got) in [
        (
            with_header(|header| {
                let part = tensor(&header);
                twice(header, &part)
            }),
            "\"step_size\" twice",
        ),
        (with_header(|header| twice(header, r#"\"format\":3"#)), "\"format\" twice"),
        (with_header(|header| twice(header, r#"\"seed\":5"#)), "\"seed\" twice"),
        (with_header(|header| twice(header, r#""dtype":"F32""#)), ""),
    ] {
        assert!(refused.starts_with("checkpoint: safetensors: ") && refused.contains(got), "{got}: {refused}");
    }
}

#[test]
fn a_render_spec_is_json_or_empty() {
    let spec = |text: &str| refusal(|_, metadata| metadata["provenance"]["render_spec"] = text.into());
    for text in ["blender", "{\"camera\":", "{} {}", "{\"a\":1,\"a\":2}"] {
        let message = spec(text);
        assert!(message.starts_with("checkpoint provenance.render_spec: expected nothing or JSON, got "), "{message}");
    }
}

/// A file may be named by mistake or with intent, and its contents must not leak into an error.
#[test]
fn a_refusal_shows_no_bytes_of_a_file() {
    let secret = b"-----BEGIN PRIVATE KEY-----\nMIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQg";
    let mut short = [0; 8];
    short[0] = 10;
    for bytes in [&secret[..], &[&short[..], &b"secret"[..]].concat(), &[&short[..], &b"{\"secret\":"[..]].concat()] {
        let message = checkpoint::from_bytes(bytes).unwrap_err().to_string();
        let first = u64::from_le_bytes(*bytes.first_chunk().unwrap()).to_string();
        let shown =
            message.contains("secret") || message.contains("BEGIN") || first.len() > 2 && message.contains(&first);
        assert!(!shown, "{message}");
    }
}

#[test]
fn another_format_is_refused() {
    assert_eq!(refusal(|_, m| m["format"] = json!(1)), "checkpoint format: expected 3, got 1");
    // An older format lacks fields, and the error names the format all the same.
    assert_eq!(refusal(|_, m| *m = json!({"format": 1})), "checkpoint format: expected 3, got 1");
    assert_eq!(refusal(|_, m| *m = json!({})), "checkpoint format: expected 3, got no number");
}

#[test]
fn a_missing_weight_is_named() {
    let message = refusal(|tensors, _| drop(tensors.remove("network.trunk.weight")));
    assert_eq!(message, "checkpoint tensor \"network.trunk.weight\": expected by the model's configuration, got none");
}

#[test]
fn an_unknown_weight_is_named() {
    let message = refusal(|tensors, _| drop(tensors.insert("extra".into(), Tensor::new(&[], &[1.0f32]))));
    assert_eq!(message, "checkpoint tensor \"extra\": not part of the model's configuration");
}

#[test]
fn a_wrong_shape_is_named() {
    let message = refusal(|_, metadata| metadata["model"]["hidden"] = json!(9));
    assert!(message.contains("expected F32[") && message.contains("got F32["), "{message}");
}

#[test]
fn a_wrong_type_is_named() {
    let message = refusal(|tensors, _| drop(tensors.insert("step_size".into(), Tensor::new(&[], &[1.0f64]))));
    assert_eq!(message, "checkpoint tensor \"step_size\": expected F32[], got F64[]");
}

#[test]
fn a_weight_of_nan_is_named() {
    let message = refusal(|tensors, _| drop(tensors.insert("step_size".into(), Tensor::new(&[], &[f32::NAN]))));
    assert_eq!(message, "checkpoint tensor \"step_size\": expected finite values, got NaN or infinity");
}

#[test]
fn a_configuration_out_of_range_is_refused() {
    let message = refusal(|_, metadata| metadata["model"]["encoder"]["latent"] = json!(1_000_000_000));
    assert_eq!(message, "checkpoint model: encoder.latent: expected 1 to 512, got 1000000000");
    let message = refusal(|_, metadata| metadata["model"]["encoder"]["convolutions"][0]["kernel"] = json!(0));
    assert_eq!(message, "checkpoint model: encoder.convolutions.kernel: expected 1 to 8, got 0");
    let message = refusal(|_, metadata| metadata["model"]["depth"] = json!(3));
    assert!(message.contains("unknown field `depth`"), "{message}");
    let message = refusal(|_, metadata| metadata["model"]["encoder"]["kind"] = json!("sound"));
    assert!(message.contains("unknown variant `sound`"), "{message}");
    let position = |spoil: fn(&mut Value)| {
        let mut encoder = serde_json::to_value(position_config(MethodKind::Cpn).encoder).unwrap();
        spoil(&mut encoder);
        refusal(|_, metadata| metadata["model"]["encoder"] = encoder)
    };
    let message = position(|encoder| encoder["scale_mm"] = json!(0));
    assert_eq!(message, "checkpoint model: encoder.scale_mm: expected 1 to 1000000, got 0");
    let message = position(|encoder| encoder["centre_mm"][2] = json!(-2_000_000));
    assert_eq!(message, "checkpoint model: encoder.centre_mm: expected -1000000 to 1000000, got -2000000");
    let message = position(|encoder| encoder["layers"][0] = json!(1_000_000));
    assert_eq!(message, "checkpoint model: encoder.layers.width: expected 1 to 512, got 1000000");
    let message = position(|encoder| encoder["centre_mm"] = json!([1, 2]));
    assert!(message.starts_with("checkpoint metadata: "), "{message}");
}

/// Names and shapes of a shipped model's tensors in the tables of `docs/checkpoint-format.md`.
fn documented() -> BTreeMap<String, String> {
    let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/checkpoint-format.md");
    let page = std::fs::read_to_string(page).unwrap();
    let rows =
        page.lines().filter(|line| line.contains("weight`") || line.contains("bias`") || line.contains("`step_size`"));
    let cells = rows.filter_map(|line| line.strip_prefix("| `")?.strip_suffix("` |")?.split_once("` |"));
    cells.filter_map(|(name, rest)| Some((name.to_owned(), rest.rsplit_once('`')?.1.to_owned()))).collect()
}

#[test]
fn the_page_lists_every_tensor_of_a_shipped_model() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/cpn.safetensors");
    let bytes = std::fs::read(path).unwrap();
    let model = checkpoint::from_bytes(&bytes).unwrap().model;
    let shapes = model.weights.iter().map(|(name, tensor)| (name.clone(), format!("{:?}", tensor.shape())));
    let mut shipped: BTreeMap<_, _> = shapes.collect();
    let documented = documented();
    assert!(documented.len() > 20, "{documented:?}");
    for (name, shape) in &documented {
        assert_eq!(shipped.remove(name).as_ref(), Some(shape), "{name}");
    }
    // The page lists the attenuation networks of the trunk, as an example of all layers.
    let trunk: Vec<_> = documented.keys().filter_map(|name| name.strip_prefix("network.trunk.")).collect();
    for layer in ["policy_0", "policy_1", "dynamics_0", "dynamics_1"] {
        for part in trunk.iter().filter(|part| part.starts_with("u.") || part.starts_with("v.")) {
            assert!(shipped.remove(&format!("network.{layer}.{part}")).is_some(), "{layer}.{part}");
        }
    }
    assert!(shipped.is_empty(), "not on the page: {shipped:?}");
}
