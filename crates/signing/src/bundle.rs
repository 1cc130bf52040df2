//! Bundle format: a Sigstore bundle around a DSSE envelope around an in-toto statement about one file.

use crate::Error;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Deserialize;
use serde::de::{DeserializeOwned, IgnoredAny};
use sha2::{Digest as _, Sha256};

/// Largest bundle, in bytes.
pub const MAX_BYTES: usize = 65_536;

const MEDIA_TYPE: &str = "application/vnd.dev.sigstore.bundle.v0.3+json";
const PAYLOAD_TYPE: &str = "application/vnd.in-toto+json";
const STATEMENT_TYPE: &str = "https://in-toto.io/Statement/v1";
const PREDICATE_TYPE: &str = "https://model_signing/signature/v1.0";
/// Serialisation method of a model: one hash per file.
const METHOD: &str = "files";
const HASH: &str = "sha256";
/// Name that the official tool gives to the only file of a single-file model, where the specification has the file's own.
const ONLY_FILE: &str = ".";

/// Well-formed but unverified bundle; see [`crate::TrustedKeys::verify`].
#[derive(Debug)]
pub struct Bundle {
    /// Statement, in JSON.
    payload: Vec<u8>,
    /// ECDSA signature of [`Self::signed_bytes`], in DER.
    pub(crate) signature: Vec<u8>,
    /// Key identifier claimed by the signer.
    pub(crate) key_hint: Option<String>,
}

/// File that a statement is about.
#[derive(Debug, PartialEq, Eq)]
struct Resource {
    name: String,
    /// SHA-256 in lower-case hex.
    digest: String,
}

impl Bundle {
    /// Parses a bundle of the public-key method with a single signature.
    ///
    /// # Errors
    /// If the bundle is larger than [`MAX_BYTES`], or malformed.
    pub fn parse(json: &[u8]) -> Result<Self, Error> {
        if json.len() > MAX_BYTES {
            return Err(Error::malformed(format!("at most {MAX_BYTES} bytes"), format!("{} bytes", json.len())));
        }
        let format::Bundle { media_type, verification_material: material, dsse_envelope: envelope } =
            read(json, "a bundle in JSON")?;

        equal("mediaType", MEDIA_TYPE, &media_type)?;
        let key = match (material.public_key, material.x509_certificate_chain.or(material.certificate)) {
            (Some(key), None) => key,
            (_, Some(IgnoredAny)) => {
                return Err(Error::malformed("a publicKey as verificationMaterial", "a certificate"));
            }
            (None, None) => return Err(Error::malformed("a publicKey as verificationMaterial", "none")),
        };

        equal("payloadType", PAYLOAD_TYPE, &envelope.payload_type)?;
        // Sigstore requires verifiers to refuse any other number.
        let [signature] = &envelope.signatures[..] else {
            return Err(Error::malformed("one signature", envelope.signatures.len()));
        };

        Ok(Self {
            payload: decode("payload", &envelope.payload)?,
            signature: decode("sig", &signature.sig)?,
            key_hint: key.hint.filter(|hint| !hint.is_empty()),
        })
    }

    /// SHA-256 of the signed file, in lower-case hex, as claimed by the unverified bundle.
    ///
    /// # Errors
    /// If the statement is malformed, or not about a single file.
    pub fn claimed_digest(&self) -> Result<String, Error> {
        Ok(self.resource()?.digest)
    }

    /// Signed bytes: DSSE's pre-authentication encoding of the payload.
    pub(crate) fn signed_bytes(&self) -> Vec<u8> {
        let head = format!("DSSEv1 {} {PAYLOAD_TYPE} {} ", PAYLOAD_TYPE.len(), self.payload.len());
        [head.as_bytes(), &self.payload].concat()
    }

    /// Checks that the statement is about this file. The name is compared only if the statement has one.
    ///
    /// # Errors
    /// If the statement is about another file or digest, is malformed, or is not about a single file.
    pub(crate) fn check_file(&self, name: &str, digest: &str) -> Result<(), Error> {
        let resource = self.resource()?;
        let mismatch = |expected, got| Err(Error::new(crate::Fault::Mismatch, expected, got));
        if resource.name != ONLY_FILE && resource.name != name {
            return mismatch(format!("one of the file {name:?}"), format!("{:?}", resource.name));
        }
        if resource.digest != digest {
            return mismatch(format!("one of the digest {digest}"), resource.digest);
        }
        Ok(())
    }

    /// Single file of the statement.
    fn resource(&self) -> Result<Resource, Error> {
        // The types come first: the shape of the rest depends on them.
        let types: format::Types = read(&self.payload, "a statement in JSON")?;
        equal("_type", STATEMENT_TYPE, &types.statement)?;
        equal("predicateType", PREDICATE_TYPE, &types.predicate)?;

        let format::Statement { subject, predicate } = read(&self.payload, "a statement in JSON")?;
        let [subject] = &subject[..] else {
            return Err(Error::malformed("one subject", subject.len()));
        };

        let format::Predicate { serialization, resources } = predicate;
        equal("serialization.method", METHOD, &serialization.method)?;
        equal("serialization.hash_type", HASH, &serialization.hash_type)?;
        let [resource] = &resources[..] else {
            return Err(Error::malformed("one file among the resources", resources.len()));
        };
        equal("algorithm", HASH, &resource.algorithm)?;
        let bytes = sha256("resources.digest", &resource.digest)?;

        // The root digest is that of the concatenated digests of all files, here a single one.
        let root = Sha256::digest(bytes);
        if sha256("subject.digest", &subject.digest.sha256)? != root[..] {
            return Err(Error::malformed(
                format!("subject.digest {}, that of the resources", hex::encode(root)),
                &subject.digest.sha256,
            ));
        }
        Ok(Resource { name: resource.name.clone(), digest: hex::encode(bytes) })
    }
}

/// SHA-256 of a file's bytes, in lower-case hex.
pub fn digest(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

/// Deserialises JSON; a duplicate of a known field is an error.
fn read<T: DeserializeOwned>(json: &[u8], expected: &str) -> Result<T, Error> {
    serde_json::from_slice(json).map_err(|error| Error::malformed(expected, error))
}

fn decode(field: &str, base64: &str) -> Result<Vec<u8>, Error> {
    STANDARD.decode(base64).map_err(|error| Error::malformed(format!("{field} in Base64"), error))
}

fn sha256(field: &str, text: &str) -> Result<[u8; 32], Error> {
    let mut bytes = [0; 32];
    let expected = || format!("{field} of 64 hexadecimal digits");
    hex::decode_to_slice(text, &mut bytes).map_err(|_| Error::malformed(expected(), format!("{text:?}")))?;
    Ok(bytes)
}

fn equal(field: &str, expected: &str, got: &str) -> Result<(), Error> {
    if got == expected { Ok(()) } else { Err(Error::malformed(format!("{field} {expected}"), format!("{got:?}"))) }
}

/// JSON of bundles and statements. The derived code refuses duplicate fields. Unknown fields are refused in the envelope and
/// ignored in the statement, as the specification requires.
mod format {
    use super::{Deserialize, IgnoredAny};

    #[derive(Deserialize)]
    #[serde(rename_all = "camelCase", deny_unknown_fields)]
    pub(super) struct Bundle {
        pub(super) media_type: String,
        pub(super) verification_material: Material,
        pub(super) dsse_envelope: Envelope,
    }

    #[derive(Deserialize)]
    #[serde(rename_all = "camelCase", deny_unknown_fields)]
    pub(super) struct Material {
        pub(super) public_key: Option<PublicKey>,
        pub(super) x509_certificate_chain: Option<IgnoredAny>,
        pub(super) certificate: Option<IgnoredAny>,
        #[serde(rename = "tlogEntries")]
        _tlog_entries: Option<IgnoredAny>,
        #[serde(rename = "timestampVerificationData")]
        _timestamp_verification_data: Option<IgnoredAny>,
    }

    #[derive(Deserialize)]
    pub(super) struct PublicKey {
        pub(super) hint: Option<String>,
    }

    #[derive(Deserialize)]
    #[serde(rename_all = "camelCase", deny_unknown_fields)]
    pub(super) struct Envelope {
        pub(super) payload: String,
        pub(super) payload_type: String,
        pub(super) signatures: Vec<Signature>,
    }

    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    pub(super) struct Signature {
        pub(super) sig: String,
        #[serde(rename = "keyid")]
        _key_id: Option<String>,
    }

    #[derive(Deserialize)]
    pub(super) struct Types {
        #[serde(rename = "_type")]
        pub(super) statement: String,
        #[serde(rename = "predicateType")]
        pub(super) predicate: String,
    }

    #[derive(Deserialize)]
    pub(super) struct Statement {
        pub(super) subject: Vec<Subject>,
        pub(super) predicate: Predicate,
    }

    #[derive(Deserialize)]
    pub(super) struct Subject {
        pub(super) digest: RootDigest,
    }

    #[derive(Deserialize)]
    pub(super) struct RootDigest {
        pub(super) sha256: String,
    }

    #[derive(Deserialize)]
    pub(super) struct Predicate {
        pub(super) serialization: Serialization,
        pub(super) resources: Vec<Resource>,
    }

    #[derive(Deserialize)]
    pub(super) struct Serialization {
        pub(super) method: String,
        pub(super) hash_type: String,
    }

    #[derive(Deserialize)]
    pub(super) struct Resource {
        pub(super) name: String,
        pub(super) algorithm: String,
        pub(super) digest: String,
    }
}
