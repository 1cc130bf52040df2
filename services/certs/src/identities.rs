//! The authority's list of what it has issued.

use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use time::OffsetDateTime;

/// Everybody that the authority knows, by identity.
#[derive(Debug, Default, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Identities {
    /// `ROLE` or `ROLE.NAME`, the common name of the certificates.
    pub identities: BTreeMap<String, Identity>,
    /// Number of the revocation list that was made last.
    pub crl_number: u64,
    /// Prefixes of keys that the router lets through; keys without a prefix if there is none.
    pub namespaces: BTreeSet<String>,
}

/// What was issued to an identity.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Identity {
    /// Hosts in the certificate: names and addresses.
    pub hosts: BTreeSet<String>,
    /// Serial numbers of its certificates, in hex, the newest last.
    pub serials: Vec<String>,
    /// Beginning of the newest certificate.
    #[serde(with = "time::serde::rfc3339")]
    pub not_before: OffsetDateTime,
    /// End of the newest certificate.
    #[serde(with = "time::serde::rfc3339")]
    pub not_after: OffsetDateTime,
    /// When it was revoked, for good.
    #[serde(with = "time::serde::rfc3339::option")]
    pub revoked: Option<OffsetDateTime>,
}

impl Identity {
    /// Whether less than a third of the newest certificate's time is left.
    pub fn expires_soon(&self, now: OffsetDateTime) -> bool {
        (self.not_after - now) * 3 < self.not_after - self.not_before
    }
}
