//! Verification of bundles by other tools, and of bundles with one fault each.

#![expect(clippy::unwrap_used, reason = "tests")]

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use p256::ecdsa::signature::Signer as _;
use p256::ecdsa::{Signature, SigningKey};
use p256::pkcs8::{EncodePublicKey as _, LineEnding};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use signing::{Bundle, Error, Fault, MAX_BYTES, TrustedKeys, digest};
use std::path::{Path, PathBuf};

const FILE: &str = "cpn.safetensors";
const CHECKPOINT: &[u8] = b"weights";

fn fixture(name: &str) -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name);
    std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn keys(name: &str) -> TrustedKeys {
    TrustedKeys::from_pem(&String::from_utf8(fixture(name)).unwrap()).unwrap()
}

fn signer(seed: u8) -> SigningKey {
    SigningKey::from_slice(&[seed; 32]).unwrap()
}

fn pem(seed: u8) -> String {
    signer(seed).verifying_key().to_public_key_pem(LineEnding::LF).unwrap()
}

fn trusted(seeds: &[u8]) -> TrustedKeys {
    TrustedKeys::from_pem(&seeds.iter().map(|seed| pem(*seed)).collect::<String>()).unwrap()
}

/// Statement about the checkpoint, as the official tool writes it.
fn statement() -> Value {
    json!({
        "_type": "https://in-toto.io/Statement/v1",
        "subject": [{ "name": FILE, "digest": { "sha256": digest(&Sha256::digest(CHECKPOINT)) } }],
        "predicateType": "https://model_signing/signature/v1.0",
        "predicate": {
            "serialization": { "method": "files", "hash_type": "sha256", "allow_symlinks": false, "ignore_paths": [".git"] },
            "resources": [{ "name": ".", "algorithm": "sha256", "digest": digest(CHECKPOINT) }],
        },
    })
}

fn signature(seed: u8, payload: &[u8]) -> Value {
    let head = format!("DSSEv1 28 application/vnd.in-toto+json {} ", payload.len());
    let signature: Signature = signer(seed).sign(&[head.as_bytes(), payload].concat());
    json!({ "sig": STANDARD.encode(signature.to_der()), "keyid": "" })
}

fn bundle_of(payload: &[u8], signatures: Value) -> Value {
    json!({
        "mediaType": "application/vnd.dev.sigstore.bundle.v0.3+json",
        "verificationMaterial": { "publicKey": { "hint": digest(pem(1).as_bytes()) }, "tlogEntries": [] },
        "dsseEnvelope": {
            "payload": STANDARD.encode(payload),
            "payloadType": "application/vnd.in-toto+json",
            "signatures": signatures,
        },
    })
}

/// Bundle around a payload, signed with key 1.
fn signed(payload: &[u8]) -> Value {
    bundle_of(payload, json!([signature(1, payload)]))
}

fn good() -> Value {
    signed(statement().to_string().as_bytes())
}

fn verify(bundle: &[u8]) -> Result<(), Error> {
    trusted(&[1]).verify(Some(bundle), FILE, CHECKPOINT).map(drop)
}

/// Asserts that the bundle is refused, with a message that contains each of `texts`.
fn refused(bundle: &[u8], fault: Fault, texts: &[&str]) {
    let error = verify(bundle).unwrap_err();
    for text in texts {
        assert!(error.fault == fault && error.to_string().contains(text), "expected {fault}: {text}, got {error:?}");
    }
    assert!(error.to_string().starts_with("signature: expected "), "{error}");
}

#[test]
fn a_trusted_key_is_named() {
    let (bundle, id) = (good().to_string(), digest(pem(1).as_bytes()));
    for trusted in [trusted(&[1]), trusted(&[2, 1]), trusted(&[1, 2])] {
        assert_eq!(trusted.verify(Some(bundle.as_bytes()), FILE, CHECKPOINT).unwrap(), id);
        assert_eq!(trusted.verify_digest(Some(bundle.as_bytes()), FILE, &digest(CHECKPOINT)).unwrap(), id);
        // The file may have been renamed, as with the official tool.
        assert_eq!(trusted.verify(Some(bundle.as_bytes()), "other.safetensors", CHECKPOINT).unwrap(), id);
    }
    assert_eq!(Bundle::parse(bundle.as_bytes()).unwrap().claimed_digest().unwrap(), digest(CHECKPOINT));
}

#[test]
fn the_official_tool_agrees() {
    let keys = keys("official/public-key.pem");
    let (name, weights) = ("weights.safetensors", fixture("official/weights.safetensors"));
    let [file, folder] = ["official/weights.safetensors.sig", "official/folder.sig"].map(fixture);
    let id = keys.ids().next().unwrap().to_owned();
    let hinted: Value = serde_json::from_slice(&file).unwrap();
    assert_eq!(hinted["verificationMaterial"]["publicKey"]["hint"], *id);
    assert_eq!(keys.verify(Some(&file), name, &weights).unwrap(), id);
    assert_eq!(keys.verify(Some(&folder), name, &weights).unwrap(), id);

    // The statement about a folder has the file's name.
    let error = keys.verify(Some(&folder), "other.safetensors", &weights).unwrap_err();
    let expected = r#"signature: expected one of the file "other.safetensors", got "weights.safetensors""#;
    assert_eq!((error.fault, error.to_string().as_str()), (Fault::Mismatch, expected));
    for at in [0, weights.len() - 1] {
        let mut changed = weights.clone();
        changed[at] ^= 1;
        assert_eq!(keys.verify(Some(&file), name, &changed).unwrap_err().fault, Fault::Mismatch);
    }
    assert_eq!(trusted(&[1]).verify(Some(&file), name, &weights).unwrap_err().fault, Fault::Untrusted);
}

/// Bundles of older releases of the official tool, whose hint is the whole key, and of another curve.
#[test]
fn bundles_of_older_releases_are_verified() {
    let keys = keys("model-transparency/public-key.pem");
    let model = fixture("model-transparency/signme-1");
    for release in ["v0.3.1", "v1.0.0"] {
        let bundle = fixture(&format!("model-transparency/{release}.sig"));
        keys.verify(Some(&bundle), "signme-1", &model).unwrap();
        assert_eq!(keys.verify(Some(&bundle), "signme-1", b"signme-2\n").unwrap_err().fault, Fault::Mismatch);
        assert_eq!(trusted(&[1]).verify(Some(&bundle), "signme-1", &model).unwrap_err().fault, Fault::Untrusted);
    }
    // Signed by a trusted key, but about a folder of two files.
    let error = keys.verify(Some(&fixture("model-transparency/v1.1.0.sig")), "signme-1", &model).unwrap_err();
    assert_eq!(error.to_string(), "signature: expected one file among the resources, got 2");
}

/// Test vectors of the specification: invalid ones, and valid ones of other methods, are malformed here.
#[test]
fn vectors_of_the_specification_are_malformed() {
    let keys = keys("model-transparency/public-key.pem");
    let error = |vector: &str| {
        let bundle = fixture(&format!("specification/{vector}.bundle.json"));
        keys.verify(Some(&bundle), "signme-1", b"signme-1\n").unwrap_err()
    };
    for (vector, text) in [
        ("invalid/empty", "EOF"),
        ("invalid/missing-envelope", "missing field `dsseEnvelope`"),
        ("invalid/missing-verification-material", "missing field `verificationMaterial`"),
        ("invalid/missing-tlog-entries", "a publicKey as verificationMaterial, got a certificate"),
        ("valid/certificate", "a publicKey as verificationMaterial, got a certificate"),
        ("valid/sigstore", "a publicKey as verificationMaterial, got a certificate"),
    ] {
        let error = error(vector);
        assert!(error.fault == Fault::Malformed && error.to_string().contains(text), "{vector}: {error:?}");
    }
    // Signed by the same key, but about a folder of two files.
    let folder = error("valid/key");
    assert_eq!(folder.to_string(), "signature: expected one file among the resources, got 2");
    // The same signature with another statement.
    assert_eq!(error("invalid-payload/wrong-predicate").fault, Fault::Untrusted);
}

#[test]
fn no_bundle_is_unsigned() {
    let error = trusted(&[1]).verify(None, FILE, CHECKPOINT).unwrap_err();
    assert_eq!(error.fault, Fault::Unsigned);
    assert_eq!(error.to_string(), "signature: expected a bundle for cpn.safetensors, got none");
}

#[test]
fn another_key_is_untrusted() {
    let bundle = good().to_string();
    for keys in [trusted(&[2]), trusted(&[2, 3]), TrustedKeys::default()] {
        let error = keys.verify(Some(bundle.as_bytes()), FILE, CHECKPOINT).unwrap_err();
        assert_eq!(error.fault, Fault::Untrusted);
        assert!(error.got.contains(&digest(pem(1).as_bytes())), "the hint is told: {error}");
    }
    // Regardless of the hint, which may name the trusted key.
    let payload = statement().to_string();
    let forged = bundle_of(payload.as_bytes(), json!([signature(2, payload.as_bytes())]));
    refused(forged.to_string().as_bytes(), Fault::Untrusted, &["and does not verify"]);
}

#[test]
fn a_changed_byte_is_noticed() {
    let bundle = good();
    let keys = trusted(&[1]);
    let text = bundle.to_string();
    for at in 0..CHECKPOINT.len() {
        let mut changed = CHECKPOINT.to_vec();
        changed[at] ^= 0x80;
        let error = keys.verify(Some(text.as_bytes()), FILE, &changed).unwrap_err();
        assert_eq!(error.fault, Fault::Mismatch);
        assert!(error.expected.ends_with(&digest(&changed)) && error.got == digest(CHECKPOINT), "{error}");
    }
    // The statement of other weights with the signature of these.
    let other = statement().to_string().replace(&digest(CHECKPOINT), &digest(b"other"));
    let mut swapped = bundle;
    swapped["dsseEnvelope"]["payload"] = STANDARD.encode(other).into();
    refused(swapped.to_string().as_bytes(), Fault::Untrusted, &["and does not verify"]);
}

#[test]
fn faults_of_a_bundle_are_named() {
    type Spoil = fn(&mut Value);
    let cases: [(Spoil, &str); 14] = [
        (|b| b["mediaType"] = "text/plain".into(), "mediaType application/vnd.dev.sigstore"),
        (|b| b["dsseEnvelope"]["payloadType"] = "text/plain".into(), "payloadType application/vnd.in-toto+json"),
        (|b| b["dsseEnvelope"]["payload"] = "%".into(), "payload in Base64"),
        (|b| b["dsseEnvelope"]["payload"] = 7.into(), "invalid type: integer `7`"),
        (|b| b["dsseEnvelope"]["signatures"] = json!([]), "one signature, got 0"),
        (|b| b["dsseEnvelope"]["signatures"][0]["sig"] = "%".into(), "sig in Base64"),
        (|b| b["dsseEnvelope"]["signatures"][0]["sig"] = Value::Null, "expected a string"),
        (|b| b["dsseEnvelope"]["signatures"][0]["more"] = 1.into(), "unknown field `more`"),
        (|b| b["dsseEnvelope"]["more"] = 1.into(), "unknown field `more`"),
        (|b| b["messageSignature"] = json!({}), "unknown field `messageSignature`"),
        (|b| b["verificationMaterial"] = json!({}), "a publicKey as verificationMaterial, got none"),
        (|b| b["verificationMaterial"]["publicKey"] = 7.into(), "invalid type: integer `7`"),
        (|b| b["verificationMaterial"]["certificate"] = json!({ "rawBytes": "" }), "got a certificate"),
        (|b| *b = json!([]), "invalid"),
    ];
    for (index, (spoil, text)) in cases.into_iter().enumerate() {
        let mut bundle = good();
        spoil(&mut bundle);
        let error = verify(bundle.to_string().as_bytes()).unwrap_err();
        assert!(error.fault == Fault::Malformed && error.to_string().contains(text), "{index}: {error}");
    }
    let mut no_signature = good();
    no_signature["dsseEnvelope"]["signatures"][0]["sig"] = "".into();
    refused(no_signature.to_string().as_bytes(), Fault::Untrusted, &["and does not verify"]);
}

#[test]
fn faults_of_a_statement_are_named() {
    type Spoil = fn(&mut Value);
    let cases: [(Spoil, Fault, &str); 18] = [
        (|s| s["_type"] = "x".into(), Fault::Malformed, "_type https://in-toto.io/Statement/v1, got \"x\""),
        (|s| s["predicateType"] = "x".into(), Fault::Malformed, "predicateType https://model_signing/signature/v1.0"),
        (|s| s["subject"] = json!([]), Fault::Malformed, "one subject, got 0"),
        (|s| drop(s.as_object_mut().unwrap().remove("subject")), Fault::Malformed, "missing field `subject`"),
        (|s| drop(s.as_object_mut().unwrap().remove("predicate")), Fault::Malformed, "missing field `predicate`"),
        (|s| s["subject"] = json!([s["subject"][0], s["subject"][0]]), Fault::Malformed, "one subject, got 2"),
        (|s| s["subject"][0]["digest"] = json!({}), Fault::Malformed, "missing field `sha256`"),
        (|s| s["subject"][0]["digest"]["sha256"] = digest(b"x").into(), Fault::Malformed, "that of the resources"),
        (|s| s["subject"][0]["digest"]["sha256"] = "x".into(), Fault::Malformed, "subject.digest of 64 hexadecimal"),
        (|s| s["predicate"]["resources"] = json!([]), Fault::Malformed, "one file among the resources, got 0"),
        (|s| s["predicate"]["resources"] = json!([1]), Fault::Malformed, "invalid type: integer `1`"),
        (|s| s["predicate"]["resources"][0]["algorithm"] = "blake3".into(), Fault::Malformed, "algorithm sha256"),
        (|s| s["predicate"]["resources"][0]["digest"] = "00".into(), Fault::Malformed, "resources.digest of 64"),
        (|s| s["predicate"]["resources"][0]["name"] = "../cpn.safetensors".into(), Fault::Mismatch, "one of the file"),
        (|s| s["predicate"]["resources"][0]["name"] = "".into(), Fault::Mismatch, "got \"\""),
        (|s| s["predicate"]["serialization"]["method"] = "shards".into(), Fault::Malformed, "method files"),
        (|s| s["predicate"]["serialization"]["hash_type"] = "blake2b".into(), Fault::Malformed, "hash_type sha256"),
        (|s| drop(s["predicate"].as_object_mut().unwrap().remove("serialization")), Fault::Malformed, "serialization"),
    ];
    for (index, (spoil, fault, text)) in cases.into_iter().enumerate() {
        let mut statement = statement();
        spoil(&mut statement);
        let error = verify(signed(statement.to_string().as_bytes()).to_string().as_bytes()).unwrap_err();
        assert!(error.fault == fault && error.to_string().contains(text), "{index}: {error:?}");
    }
    for payload in [&b""[..], b"{", b"null", b"[]", b"\xff", b"\"text\""] {
        refused(signed(payload).to_string().as_bytes(), Fault::Malformed, &["a statement in JSON"]);
    }

    // Fields that a later release may add.
    let mut more = statement();
    more["more"] = 1.into();
    more["predicate"]["card"] = json!({});
    more["predicate"]["resources"][0]["annotations"] = json!({});
    verify(signed(more.to_string().as_bytes()).to_string().as_bytes()).unwrap();
}

#[test]
fn a_payload_of_another_type_is_refused() {
    // Signed with its own type, so that the signature itself is good.
    let (payload, kind) = (statement().to_string(), "application/json");
    let head = format!("DSSEv1 {} {kind} {} ", kind.len(), payload.len());
    let signature: Signature = signer(1).sign(&[head.as_bytes(), payload.as_bytes()].concat());
    let mut bundle = bundle_of(payload.as_bytes(), json!([{ "sig": STANDARD.encode(signature.to_der()) }]));
    refused(bundle.to_string().as_bytes(), Fault::Untrusted, &["and does not verify"]);
    bundle["dsseEnvelope"]["payloadType"] = kind.into();
    refused(bundle.to_string().as_bytes(), Fault::Malformed, &["payloadType", kind]);
}

#[test]
fn more_than_one_signature_is_refused() {
    let payload = statement().to_string();
    let both = json!([signature(1, payload.as_bytes()), signature(2, payload.as_bytes())]);
    let bundle = bundle_of(payload.as_bytes(), both).to_string();
    let error = trusted(&[1, 2]).verify(Some(bundle.as_bytes()), FILE, CHECKPOINT).unwrap_err();
    assert_eq!(error.to_string(), "signature: expected one signature, got 2");
}

#[test]
fn the_key_identifier_of_a_signature_may_be_missing() {
    for key_id in [None, Some(Value::Null), Some("".into()), Some("any".into())] {
        let mut bundle = good();
        let signature = bundle["dsseEnvelope"]["signatures"][0].as_object_mut().unwrap();
        signature.remove("keyid");
        if let Some(key_id) = key_id {
            signature.insert("keyid".into(), key_id);
        }
        bundle["verificationMaterial"] = json!({ "publicKey": {} });
        verify(bundle.to_string().as_bytes()).unwrap();
    }
}

#[test]
fn every_truncation_is_refused() {
    let bundle = good().to_string();
    for length in 0..bundle.len() {
        let error = verify(&bundle.as_bytes()[..length]).unwrap_err();
        assert_eq!(error.fault, Fault::Malformed, "{length}");
    }
}

#[test]
fn every_changed_byte_of_a_bundle_is_refused_or_means_nothing() {
    let bundle = good().to_string().into_bytes();
    let mut accepted = Vec::new();
    for at in 0..bundle.len() {
        let mut changed = bundle.clone();
        changed[at] ^= 1;
        if verify(&changed).is_ok() {
            accepted.push(at);
        }
    }
    // Without effect: the hint, and the names of optional fields.
    let text = String::from_utf8(bundle).unwrap();
    let envelope = text.find("\"payload\"").unwrap()..text.find("\"signatures\"").unwrap();
    assert!(accepted.iter().all(|at| !envelope.contains(at)), "{accepted:?}");
}

#[test]
fn duplicate_fields_are_refused() {
    let bundle = good().to_string();
    let twice = bundle.replacen("{\"dsseEnvelope\":", "{\"dsseEnvelope\":null,\"dsseEnvelope\":", 1);
    assert_ne!(twice, bundle);
    refused(twice.as_bytes(), Fault::Malformed, &[""]);
    let kind = "\"mediaType\":\"application/vnd.dev.sigstore.bundle.v0.3+json\"";
    let twice = bundle.replacen(kind, &format!("{kind},{kind}"), 1);
    refused(twice.as_bytes(), Fault::Malformed, &["duplicate field `mediaType`"]);

    let statement = statement().to_string();
    for field in
        ["\"name\":\".\"", "\"predicateType\":\"https://model_signing/signature/v1.0\"", "\"method\":\"files\""]
    {
        let twice = statement.replacen(field, &format!("{field},{field}"), 1);
        assert_ne!(twice, statement);
        refused(signed(twice.as_bytes()).to_string().as_bytes(), Fault::Malformed, &["duplicate field"]);
    }
}

#[test]
fn large_and_deep_bundles_are_refused() {
    let large = vec![b' '; MAX_BYTES + 1];
    refused(&large, Fault::Malformed, &["at most 65536 bytes, got 65537 bytes"]);
    let mut padded = good().to_string().into_bytes();
    padded.resize(MAX_BYTES, b' ');
    verify(&padded).unwrap();
    let deep = format!("{{\"mediaType\":{}", "[".repeat(MAX_BYTES - 20));
    refused(deep.as_bytes(), Fault::Malformed, &["a bundle in JSON"]);
    let mut bundle = good();
    bundle["verificationMaterial"]["tlogEntries"] =
        serde_json::from_str(&"[".repeat(100).chars().chain("]".repeat(100).chars()).collect::<String>()).unwrap();
    verify(bundle.to_string().as_bytes()).unwrap();
    let long = bundle_of(b"", json!([])).to_string().replace("v0.3+json", &"x".repeat(9999));
    let error = verify(long.as_bytes()).unwrap_err();
    assert!(error.to_string().len() < 600, "{}", error.to_string().len());
}

#[test]
fn files_of_keys_are_checked() {
    let [one, two] = [pem(1), pem(2)];
    let ids = |text: &str| TrustedKeys::from_pem(text).map(|keys| keys.ids().map(str::to_owned).collect::<Vec<_>>());
    let expected = [&one, &two].map(|pem| digest(pem.as_bytes()));
    let with_text = format!("key of 2026\n{one}\nthe next\r\n{}", two.replace('\n', "\r\n"));
    assert_eq!(ids(&format!("{one}{two}")).unwrap(), expected);
    assert_eq!(ids(&with_text).unwrap(), expected);
    let private = "-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n";
    let noise = "-----BEGIN PUBLIC KEY-----\nAAAA\n-----END PUBLIC KEY-----\n";
    let ed25519 = "-----BEGIN PUBLIC KEY-----\nMCowBQYDK2VwAyEAGb9ECWmEzf6FQbrBZ9w7lshQhqowtrbLDFw4rXAxZuE=\n-----END PUBLIC KEY-----\n";
    for (text, got) in [
        (String::new(), "none"),
        (private.into(), "none"),
        (noise.into(), "something else as number 1"),
        (format!("{one}{ed25519}"), "something else as number 2"),
        (one[..one.len() - 30].into(), "something else as number 1"),
        ("x".repeat(70_000), "70000 bytes"),
    ] {
        let error = ids(&text).unwrap_err().to_string();
        assert_eq!(error, format!("public key: expected ECDSA keys on P-256 or P-384, in PEM, got {got}"));
    }
    let mut keys = trusted(&[1]);
    keys.extend(trusted(&[2]));
    assert_eq!(keys.ids().collect::<Vec<_>>(), expected);
    assert!(!keys.is_empty() && TrustedKeys::default().is_empty());
}

/// Shipped models are signed with the key beside them.
#[test]
fn the_shipped_models_are_signed() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../models");
    let keys = std::fs::read_to_string(models.join("cpn-models.pub.pem")).unwrap();
    let keys = TrustedKeys::from_pem(&keys).unwrap();
    let entries = std::fs::read_dir(&models).unwrap().map(|entry| entry.unwrap().path());
    let checkpoints: Vec<PathBuf> =
        entries.filter(|path| path.extension().is_some_and(|e| e == "safetensors")).collect();
    assert!(checkpoints.len() >= 4, "{checkpoints:?}");
    for path in checkpoints {
        let name = path.file_name().unwrap().to_str().unwrap();
        let bundle = std::fs::read(models.join(format!("{name}.sig"))).unwrap();
        keys.verify(Some(&bundle), name, &std::fs::read(&path).unwrap()).unwrap_or_else(|e| panic!("{name}: {e}"));
    }
}
