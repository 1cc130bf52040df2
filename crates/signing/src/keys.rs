//! Trusted public keys, and verification against them.

use crate::{Bundle, Error, Fault, bundle};
use p256::ecdsa::signature::Verifier as _;
use p256::pkcs8::{DecodePublicKey as _, EncodePublicKey as _, LineEnding};

const BEGIN: &str = "-----BEGIN PUBLIC KEY-----";
const END: &str = "-----END PUBLIC KEY-----";
/// Largest file of public keys, in bytes.
const MAX_PEM_BYTES: usize = 65_536;

/// Set of trusted public keys.
#[derive(Debug, Clone, Default)]
pub struct TrustedKeys(Vec<TrustedKey>);

#[derive(Debug, Clone)]
struct TrustedKey {
    key: Key,
    /// SHA-256 of the key's PEM, in hex: the hint that the official tool puts into a bundle.
    id: String,
}

#[derive(Debug, Clone)]
enum Key {
    P256(p256::ecdsa::VerifyingKey),
    P384(p384::ecdsa::VerifyingKey),
}

/// Invalid file of public keys.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("public key: expected {expected}, got {got}")]
pub struct KeyError {
    expected: &'static str,
    got: String,
}

impl TrustedKeys {
    /// Parses one or more ECDSA keys on P-256 or P-384, in PEM.
    ///
    /// # Errors
    /// If the text is larger than 64 KiB, has no key, or a malformed one.
    pub fn from_pem(text: &str) -> Result<Self, KeyError> {
        let error = |got: String| KeyError { expected: "ECDSA keys on P-256 or P-384, in PEM", got };
        if text.len() > MAX_PEM_BYTES {
            return Err(error(format!("{} bytes", text.len())));
        }
        // PEM allows text around the keys.
        let (_, blocks) = text.split_once(BEGIN).ok_or_else(|| error("none".into()))?;
        let keys = blocks.split(BEGIN).enumerate().map(|(index, block)| {
            let end = block.find(END).map_or(block.len(), |start| start + END.len());
            let pem = format!("{BEGIN}{}\n", &block[..end]);
            TrustedKey::from_pem(&pem).ok_or_else(|| error(format!("something else as number {}", index + 1)))
        });
        Ok(Self(keys.collect::<Result<_, _>>()?))
    }

    /// Adds the keys of another set.
    pub fn extend(&mut self, others: Self) {
        self.0.extend(others.0);
    }

    /// Whether the set is empty.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Identifiers of the keys: SHA-256 of their PEM, in hex, as the hint in a bundle.
    pub fn ids(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|key| key.id.as_str())
    }

    /// Verifies that one of the keys signed a file of these bytes, and returns the key's identifier.
    ///
    /// # Errors
    /// If there is no bundle, it is malformed, its signature is by none of the keys, or it is about another file.
    pub fn verify(&self, bundle: Option<&[u8]>, file_name: &str, bytes: &[u8]) -> Result<&str, Error> {
        self.verify_digest(bundle, file_name, &bundle::digest(bytes))
    }

    /// [`Self::verify`] for a file given by its SHA-256, in lower-case hex.
    ///
    /// # Errors
    /// As [`Self::verify`].
    pub fn verify_digest(&self, bundle: Option<&[u8]>, file_name: &str, digest: &str) -> Result<&str, Error> {
        let bundle = bundle.ok_or_else(|| Error::new(Fault::Unsigned, format!("a bundle for {file_name}"), "none"))?;
        let bundle = Bundle::parse(bundle)?;

        // The hint is unverified, so that every key is tried.
        let signed = bundle.signed_bytes();
        let signer = self.0.iter().find(|trusted| trusted.key.verifies(&bundle.signature, &signed));
        let Some(signer) = signer else {
            let hinted = self.0.iter().find(|trusted| Some(&trusted.id) == bundle.key_hint.as_ref());
            let got = match (hinted, &bundle.key_hint) {
                (Some(trusted), _) => format!("one that names key {} and does not verify", trusted.id),
                (None, Some(hint)) => format!("one by key {hint:?}"),
                (None, None) => "one by another".into(),
            };
            let ids: Vec<_> = self.ids().collect();
            return Err(Error::new(Fault::Untrusted, format!("one by key {}", ids.join(" or ")), got));
        };

        bundle.check_file(file_name, digest)?;
        Ok(&signer.id)
    }
}

impl TrustedKey {
    fn from_pem(pem: &str) -> Option<Self> {
        let p256 = || p256::ecdsa::VerifyingKey::from_public_key_pem(pem).ok().map(Key::P256);
        let p384 = || p384::ecdsa::VerifyingKey::from_public_key_pem(pem).ok().map(Key::P384);
        let key = p256().or_else(p384)?;
        let canonical = match &key {
            Key::P256(key) => key.to_public_key_pem(LineEnding::LF),
            Key::P384(key) => key.to_public_key_pem(LineEnding::LF),
        };
        Some(Self { id: bundle::digest(canonical.ok()?.as_bytes()), key })
    }
}

impl Key {
    /// Whether a signature, in DER, is valid for these bytes and this key.
    fn verifies(&self, signature: &[u8], signed: &[u8]) -> bool {
        match self {
            Self::P256(key) => p256::ecdsa::Signature::from_der(signature).and_then(|s| key.verify(signed, &s)).is_ok(),
            Self::P384(key) => p384::ecdsa::Signature::from_der(signature).and_then(|s| key.verify(signed, &s)).is_ok(),
        }
    }
}
