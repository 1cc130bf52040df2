//! Signatures of checkpoints: no bundle, statement or key makes the verifier panic, errors are short, and only signatures by
//! trusted keys are accepted.

#![no_main]

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use libfuzzer_sys::fuzz_target;
use p256::ecdsa::signature::Signer as _;
use p256::ecdsa::{Signature, SigningKey};
use p256::pkcs8::{EncodePublicKey as _, LineEnding};
use signing::{Bundle, Error, TrustedKeys, digest};
use std::sync::LazyLock;

/// Maximum length of an error, in bytes; it quotes the bundle.
const MAX_ERROR_BYTES: usize = 500;
const CHECKPOINT: &[u8] = b"weights";
const FILE: &str = "cpn.safetensors";

static SIGNER: LazyLock<SigningKey> = LazyLock::new(|| SigningKey::from_slice(&[1; 32]).expect("a scalar"));
static PEM: LazyLock<String> =
    LazyLock::new(|| SIGNER.verifying_key().to_public_key_pem(LineEnding::LF).expect("a point"));
static TRUSTED: LazyLock<TrustedKeys> = LazyLock::new(|| TrustedKeys::from_pem(&PEM).expect("a key"));

fuzz_target!(init: fuzz::seed("signature", inputs(), check), |input: &[u8]| {
    if let Err(error) = check(input) {
        assert!(error.len() <= MAX_ERROR_BYTES, "{error}");
    }
});

/// Checks an input: by its first byte keys, a statement to be signed, or a bundle.
fn check(input: &[u8]) -> Result<(), String> {
    let text = |error: Error| error.to_string();
    match input {
        [] => Ok(()),
        [0, keys @ ..] => {
            let keys = TrustedKeys::from_pem(&String::from_utf8_lossy(keys)).map_err(|e| e.to_string())?;
            assert!(!keys.is_empty() && keys.ids().all(|id| id.len() == 64));
            Ok(())
        }
        [1, statement @ ..] => TRUSTED.verify(Some(&signed(statement)), FILE, CHECKPOINT).map(drop).map_err(text),
        [_, bundle @ ..] => {
            let verified = TRUSTED.verify(Some(bundle), FILE, CHECKPOINT).map(drop).map_err(text);
            if verified.is_ok() {
                // A second valid ECDSA signature exists for each, but the statement must be the signed one.
                let claimed = Bundle::parse(bundle).and_then(|bundle| bundle.claimed_digest());
                assert_eq!(claimed.as_ref(), Ok(&digest(CHECKPOINT)));
            }
            verified
        }
    }
}

fn inputs() -> Vec<Vec<u8>> {
    let after = |first: u8, rest: &[u8]| [&[first], rest].concat();
    let statement = statement();
    vec![
        after(0, PEM.as_bytes()),
        after(0, format!("two keys\n{}{}", *PEM, *PEM).as_bytes()),
        after(1, statement.as_bytes()),
        after(2, &signed(statement.as_bytes())),
    ]
}

fn statement() -> String {
    let digest = digest(CHECKPOINT);
    let raw: Vec<u8> = (0..32).map(|i| u8::from_str_radix(&digest[2 * i..2 * i + 2], 16).expect("hex")).collect();
    format!(
        r#"{{"_type":"https://in-toto.io/Statement/v1","subject":[{{"name":"{FILE}","digest":{{"sha256":"{}"}}}}],"predicateType":"https://model_signing/signature/v1.0","predicate":{{"serialization":{{"method":"files","hash_type":"sha256","allow_symlinks":false}},"resources":[{{"name":".","algorithm":"sha256","digest":"{digest}"}}]}}}}"#,
        signing::digest(&raw)
    )
}

/// A bundle of a payload signed by the trusted key.
fn signed(payload: &[u8]) -> Vec<u8> {
    let head = format!("DSSEv1 28 application/vnd.in-toto+json {} ", payload.len());
    let signature: Signature = SIGNER.sign(&[head.as_bytes(), payload].concat());
    format!(
        r#"{{"mediaType":"application/vnd.dev.sigstore.bundle.v0.3+json","verificationMaterial":{{"publicKey":{{"hint":"{}"}}}},"dsseEnvelope":{{"payload":"{}","payloadType":"application/vnd.in-toto+json","signatures":[{{"sig":"{}"}}]}}}}"#,
        digest(PEM.as_bytes()),
        STANDARD.encode(payload),
        STANDARD.encode(signature.to_der())
    )
    .into_bytes()
}
