//! The authority's list of identities and issued certificates.

use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use time::OffsetDateTime;

/// Known identities.
#[derive(Debug, Default, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Identities {
    /// Identities by name, `ROLE` or `ROLE.NAME`: the common name of the certificates.
    pub identities: BTreeMap<String, Identity>,
    /// Number of the latest revocation list.
    pub crl_number: u64,
    /// Key prefixes that the router admits; keys without a prefix if there is none.
    pub namespaces: BTreeSet<String>,
}

/// Identity with its issued certificates.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Identity {
    /// Host names and addresses in the newest certificate.
    pub hosts: BTreeSet<String>,
    /// Serial numbers of all certificates, in hex, the newest last.
    pub serials: Vec<String>,
    /// Start of the newest certificate's validity.
    #[serde(with = "time::serde::rfc3339")]
    pub not_before: OffsetDateTime,
    /// End of the newest certificate's validity.
    #[serde(with = "time::serde::rfc3339")]
    pub not_after: OffsetDateTime,
    /// Time of the revocation, which is final.
    #[serde(with = "time::serde::rfc3339::option")]
    pub revoked: Option<OffsetDateTime>,
}

impl Identity {
    /// Whether less than a third of the newest certificate's lifetime is left.
    pub fn expires_soon(&self, now: OffsetDateTime) -> bool {
        (self.not_after - now) * 3 < self.not_after - self.not_before
    }
}
