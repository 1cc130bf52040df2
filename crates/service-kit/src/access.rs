//! Authentication and authorisation of clients, by certificate or bearer token.

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

/// Largest token file, in bytes.
const MAX_BYTES: usize = 1 << 20;

/// Contents of a token file.
#[derive(Debug, Default, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenFile {
    /// Accepted tokens.
    pub tokens: Vec<TokenEntry>,
}

/// Accepted token, stored as its digest only, since it is a secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TokenEntry {
    /// Identity of the bearer, `ROLE` or `ROLE.NAME`.
    pub identity: String,
    /// SHA-256 of the token, in hex.
    pub sha256: String,
}

/// SHA-256 of a token, in hex.
pub fn token_digest(token: &str) -> String {
    hex::encode(Sha256::digest(token))
}

/// Remote side of a connection.
#[derive(Debug, Clone)]
pub struct Peer {
    /// Remote address.
    pub address: SocketAddr,
    /// Common name of the client's certificate, if it presented one.
    pub certificate: Option<String>,
}

/// Reason for refusing a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// Neither certificate nor token.
    #[error("authorization: expected a client certificate or a token, got none")]
    Missing,
    /// Unknown token.
    #[error("authorization: expected a token that is known, got another")]
    Unknown,
    /// Role without the permission.
    #[error("authorization: expected a role that may do this, got another")]
    Forbidden,
}

/// Access control of a listener. Without TLS and without tokens, as on the loopback interface, every client is served.
#[derive(Debug, Clone, Default)]
pub struct Access {
    required: bool,
    /// Identities, by the digests of their tokens.
    tokens: Arc<HashMap<String, String>>,
}

impl Access {
    /// Access control by certificates, if there is TLS, and by the tokens of a file.
    ///
    /// # Errors
    /// If the token file cannot be read or is malformed.
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

    /// Authorises a client for `what`, if `allows` holds for its identity. A refusal is logged, and counted in
    /// `cpn_access_refused_total`. `authorization` is the request's header, `Bearer TOKEN` or `Api-Key TOKEN`; without one, the
    /// client's certificate counts.
    ///
    /// # Errors
    /// If the client has neither certificate nor token, its token is unknown, or its role lacks the permission.
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
