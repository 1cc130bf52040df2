//! Telling clients apart: by their certificates, or by bearer tokens.

use crate::files;
use anyhow::Context;
use metrics::counter;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use tracing::warn;

/// Largest file of tokens.
const MAX_BYTES: usize = 1 << 20;

/// A file of tokens.
#[derive(Debug, Default, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenFile {
    /// Every token that is accepted.
    pub tokens: Vec<TokenEntry>,
}

/// A token that is accepted. It is a secret, so that only its digest is kept.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenEntry {
    /// Identity of its bearer, `ROLE` or `ROLE.NAME`.
    pub identity: String,
    /// SHA-256 of the token, in hex.
    pub sha256: String,
}

/// SHA-256 of a token, in hex.
pub fn token_digest(token: &str) -> String {
    hex::encode(Sha256::digest(token))
}

/// A client as its listener sees it.
#[derive(Debug, Clone)]
pub struct Peer {
    /// Where it connects from.
    pub address: SocketAddr,
    /// The common name of its certificate, if it has shown one.
    pub certificate: Option<String>,
}

/// Why a client is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// It has shown nothing.
    #[error("authorization: expected a client certificate or a token, got none")]
    Missing,
    /// Its token is not known.
    #[error("authorization: expected a token that is known, got another")]
    Unknown,
    /// Its role may not do it.
    #[error("authorization: expected a role that may do this, got another")]
    Forbidden,
}

/// Decides which clients a listener serves. Without TLS and without tokens, as on the loopback interface, all of them.
#[derive(Debug, Clone, Default)]
pub struct Access {
    required: bool,
    /// Identities by the digests of their tokens.
    tokens: Arc<HashMap<String, String>>,
}

impl Access {
    /// Access by certificates, if there is TLS, and by the tokens of a file.
    ///
    /// # Errors
    /// If the file cannot be read or is malformed.
    pub fn new(tls: bool, tokens: Option<&Path>) -> anyhow::Result<Self> {
        let required = tls || tokens.is_some();
        let Some(file) = tokens else { return Ok(Self { required, tokens: Arc::default() }) };
        let read = || {
            let TokenFile { tokens } = serde_json::from_slice(&files::read_all(file, MAX_BYTES)?)?;
            let tokens: HashMap<_, _> = tokens.into_iter().map(|entry| (entry.sha256, entry.identity)).collect();
            anyhow::Ok(tokens)
        };
        let tokens = read().with_context(|| format!("tokens {}", file.display()))?;
        Ok(Self { required, tokens: Arc::new(tokens) })
    }

    /// Lets a client do something that `allows` says of its identity, or refuses, with a line in the log and a count in
    /// `cpn_access_refused_total`. `authorization` is the header of the request, `Bearer TOKEN` or `Api-Key TOKEN`.
    ///
    /// # Errors
    /// Why not.
    pub fn check(
        &self,
        peer: &Peer,
        authorization: Option<&str>,
        what: &str,
        allows: impl FnOnce(&str) -> bool,
    ) -> Result<(), Refusal> {
        if !self.required {
            return Ok(());
        }
        let identity = match authorization.and_then(|header| header.split_once(' ')) {
            Some((_, token)) => self.tokens.get(&token_digest(token)).ok_or(Refusal::Unknown),
            None => peer.certificate.as_ref().ok_or(Refusal::Missing),
        };
        let refusal = match identity {
            Ok(identity) if allows(identity) => return Ok(()),
            Ok(_) => Refusal::Forbidden,
            Err(refusal) => refusal,
        };
        let reason = match refusal {
            Refusal::Missing => "missing",
            Refusal::Unknown => "unknown",
            Refusal::Forbidden => "forbidden",
        };
        let identity = identity.map_or("unknown", String::as_str);
        counter!("cpn_access_refused_total", "reason" => reason).increment(1);
        warn!(client = %peer.address, identity, what, reason, "a client was refused");
        Err(refusal)
    }
}
