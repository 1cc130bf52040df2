//! Keys, and bundles of signatures.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use p256::ecdsa::signature::Signer as _;
use p256::ecdsa::{Signature, SigningKey};
use p256::pkcs8::{EncodePublicKey as _, LineEnding};
use serde_json::json;

fn key(seed: u8) -> SigningKey {
    SigningKey::from_slice(&[seed; 32]).expect("a key")
}

/// Public key of a seed, in PEM.
///
/// # Panics
///
/// If the seed is 0.
pub fn public_key(seed: u8) -> String {
    key(seed).verifying_key().to_public_key_pem(LineEnding::LF).expect("a key in PEM")
}

/// Bundle for a file of these bytes by the key of a seed, as the official tool writes it.
///
/// # Panics
///
/// If the seed is 0.
pub fn bundle(seed: u8, bytes: &[u8]) -> String {
    let digest = signing::digest(bytes);
    let root = signing::digest(&hex::decode(&digest).expect("a digest in hexadecimal"));
    let payload = json!({
        "_type": "https://in-toto.io/Statement/v1",
        "subject": [{ "name": "model", "digest": { "sha256": root } }],
        "predicateType": "https://model_signing/signature/v1.0",
        "predicate": {
            "serialization": { "method": "files", "hash_type": "sha256", "allow_symlinks": false },
            "resources": [{ "name": ".", "algorithm": "sha256", "digest": digest }],
        },
    })
    .to_string();
    let signed = format!("DSSEv1 28 application/vnd.in-toto+json {} {payload}", payload.len());
    let signature: Signature = key(seed).sign(signed.as_bytes());
    json!({
        "mediaType": "application/vnd.dev.sigstore.bundle.v0.3+json",
        "verificationMaterial": { "publicKey": { "hint": signing::digest(public_key(seed).as_bytes()) } },
        "dsseEnvelope": {
            "payload": STANDARD.encode(payload),
            "payloadType": "application/vnd.in-toto+json",
            "signatures": [{ "sig": STANDARD.encode(signature.to_der()) }],
        },
    })
    .to_string()
}
