//! Certificate authority: issues, renews and revokes certificates.
//!
//! ```text
//! FOLDER/authority/    key, certificate and list of identities of the authority: never distributed
//! FOLDER/IDENTITY/     ca.pem, certificate.pem, private-key.pem, crl.pem: for the process of that identity
//! FOLDER/ROUTER/       the same, and router.json5 for zenohd
//! ```

use crate::identities::{Identities, Identity};
use crate::router;
use anyhow::{Context, ensure};
use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyIdMethod, KeyPair, KeyUsagePurpose, RevokedCertParams, SerialNumber,
};
use service_kit::files;
use std::collections::BTreeSet;
use std::fs::File;
use std::path::{Path, PathBuf};
use time::{Duration, OffsetDateTime};
use wire::access::Role;

/// Name of the authority's own folder.
pub(crate) const AUTHORITY: &str = "authority";
/// Lifetime of the authority's certificate, in days.
const CA_DAYS: i64 = 3650;
/// Tolerated clock skew.
const CLOCK_SKEW: Duration = Duration::minutes(5);
/// Host names in every certificate, besides the requested ones.
const LOCAL_HOSTS: [&str; 3] = ["localhost", "127.0.0.1", "::1"];
/// Largest file of the authority, in bytes.
const MAX_BYTES: usize = 16 << 20;

/// Certificate authority in a folder, locked against other processes.
#[derive(Debug)]
pub struct Authority {
    folder: PathBuf,
    ca: String,
    issuer: Issuer<'static, KeyPair>,
    identities: Identities,
    lifetime: Duration,
    _lock: File,
}

impl Authority {
    /// Opens the authority of a folder, or creates one if there is none. New certificates are valid for `days` days.
    ///
    /// # Errors
    /// If the folder cannot be read or written, another process has it, or a file in it is malformed.
    pub fn open(folder: &Path, days: u16) -> anyhow::Result<Self> {
        let own = folder.join(AUTHORITY);
        let lock = files::take_over(&own)?;
        let (ca, key) = (own.join("ca.pem"), own.join("private-key.pem"));
        if !ca.exists() {
            let (certificate, private_key) = new_ca()?;
            files::write_secret(&key, private_key.as_bytes())?;
            files::write_atomically(&ca, certificate.as_bytes())?;
        }

        let read = |path: &Path| {
            let bytes = files::read_all(path, MAX_BYTES).with_context(|| path.display().to_string())?;
            String::from_utf8(bytes).with_context(|| path.display().to_string())
        };
        let key_pair = KeyPair::from_pem(&read(&key)?).with_context(|| key.display().to_string())?;
        let ca_pem = read(&ca)?;
        let issuer = Issuer::from_ca_cert_pem(&ca_pem, key_pair).with_context(|| ca.display().to_string())?;

        let list = own.join("identities.json");
        let identities = if list.exists() {
            serde_json::from_str(&read(&list)?).with_context(|| list.display().to_string())?
        } else {
            Identities::default()
        };
        let lifetime = Duration::days(days.into());
        Ok(Self { folder: folder.to_owned(), ca: ca_pem, issuer, identities, lifetime, _lock: lock })
    }

    /// Known identities.
    pub fn identities(&self) -> &Identities {
        &self.identities
    }

    /// Issues a certificate with the hosts for each role that has none, and renews certificates that expire soon. The router
    /// admits keys below these `namespaces`, or without a prefix if there is none.
    ///
    /// # Errors
    /// If a host is malformed, or a file cannot be written.
    pub fn init(&mut self, hosts: &BTreeSet<String>, namespaces: BTreeSet<String>) -> anyhow::Result<()> {
        self.identities.namespaces = namespaces;
        for role in Role::ALL {
            let known = self.identities.identities.get(role.name());
            let lacks_hosts = known.is_none_or(|identity| !hosts.is_subset(&identity.hosts));
            if lacks_hosts && known.is_none_or(|identity| identity.revoked.is_none()) {
                self.certify(role.name(), hosts)?;
            }
        }
        self.renew(&[])
    }

    /// Issues a certificate to an identity, `ROLE` or `ROLE.NAME`; its earlier ones stay valid.
    ///
    /// # Errors
    /// If the identity or a host is malformed, the identity was revoked, or a file cannot be written.
    pub fn issue(&mut self, identity: &str, hosts: &BTreeSet<String>) -> anyhow::Result<()> {
        self.certify(identity, hosts)?;
        self.write_shared()
    }

    /// Renews the certificates of these identities, or, if none is named, all with less than a third of their lifetime left.
    ///
    /// # Errors
    /// If an identity is unknown or was revoked, or a file cannot be written.
    pub fn renew(&mut self, names: &[String]) -> anyhow::Result<()> {
        let now = OffsetDateTime::now_utc();
        for name in names {
            ensure!(self.identities.identities.contains_key(name), "identity: expected one that is known, got {name}");
        }
        let due = self.identities.identities.iter().filter(|(name, identity)| {
            names.contains(name) || names.is_empty() && identity.revoked.is_none() && identity.expires_soon(now)
        });
        let due: Vec<_> = due.map(|(name, identity)| (name.clone(), identity.hosts.clone())).collect();
        for (name, hosts) in due {
            self.certify(&name, &hosts)?;
        }
        self.write_shared()
    }

    /// Revokes an identity for good: puts all its certificates on the revocation list, and removes it from the routers'
    /// configuration.
    ///
    /// # Errors
    /// If the identity is unknown, or a file cannot be written.
    pub fn revoke(&mut self, name: &str) -> anyhow::Result<()> {
        let identity = self.identities.identities.get_mut(name);
        let identity = identity.with_context(|| format!("identity: expected one that is known, got {name}"))?;
        identity.revoked.get_or_insert(OffsetDateTime::now_utc());
        self.write_shared()
    }

    /// Folder of an identity.
    pub fn folder(&self, identity: &str) -> PathBuf {
        self.folder.join(identity)
    }

    fn certify(&mut self, name: &str, hosts: &BTreeSet<String>) -> anyhow::Result<()> {
        check_identity(name)?;
        let known = self.identities.identities.get(name);
        let revoked = known.is_some_and(|identity| identity.revoked.is_some());
        ensure!(!revoked, "identity: expected one that was not revoked, got {name}");

        let mut hosts = hosts.clone();
        let role = Role::of(name).map(Role::name);
        hosts.extend(LOCAL_HOSTS.into_iter().chain(role).map(str::to_owned));

        let mut params = CertificateParams::new(hosts.iter().cloned().collect::<Vec<_>>())
            .with_context(|| format!("hosts: expected names or addresses, got {hosts:?}"))?;
        let now = OffsetDateTime::now_utc();
        let serial: [u8; 16] = rand::random();
        (params.not_before, params.not_after) = (now - CLOCK_SKEW, now + self.lifetime);
        params.distinguished_name = rcgen::DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, name);
        // Positive, as RFC 5280 requires.
        let serial = [&[1][..], &serial].concat();
        params.serial_number = Some(SerialNumber::from_slice(&serial));
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        params.use_authority_key_identifier_extension = true;
        let key = KeyPair::generate()?;
        let certificate = params.signed_by(&key, &self.issuer)?;

        let mut serials = known.map(|identity| identity.serials.clone()).unwrap_or_default();
        serials.push(hex::encode(serial));
        let (not_before, not_after) = (params.not_before, params.not_after);
        let identity = Identity { hosts, serials, not_before, not_after, revoked: None };
        self.identities.identities.insert(name.to_owned(), identity);
        // Before the certificate is written, so that every certificate in use can be revoked.
        self.write_identities()?;

        let folder = self.folder(name);
        files::write_secret(&folder.join("private-key.pem"), key.serialize_pem().as_bytes())?;
        files::write_atomically(&folder.join("certificate.pem"), certificate.pem().as_bytes())?;
        files::write_atomically(&folder.join("ca.pem"), self.ca.as_bytes())
    }

    fn write_identities(&self) -> anyhow::Result<()> {
        let list = serde_json::to_vec_pretty(&self.identities)?;
        files::write_atomically(&self.folder.join(AUTHORITY).join("identities.json"), &list)
    }

    /// Writes the files derived from the list of identities: the revocation list, and the routers' configuration.
    fn write_shared(&mut self) -> anyhow::Result<()> {
        self.identities.crl_number += 1;
        self.write_identities()?;
        let crl = self.revocation_list()?;
        for (name, identity) in &self.identities.identities {
            if identity.revoked.is_some() {
                continue;
            }
            files::write_atomically(&self.folder(name).join("crl.pem"), crl.as_bytes())?;
            if Role::of(name) == Some(Role::Router) {
                let folder = std::path::absolute(self.folder(name))?;
                let config = router::config(&folder, &self.identities)?;
                let text = serde_json::to_vec_pretty(&config)?;
                files::write_atomically(&folder.join("router.json5"), &text)?;
            }
        }
        Ok(())
    }

    fn revocation_list(&self) -> anyhow::Result<String> {
        let mut revoked_certs = Vec::new();
        for identity in self.identities.identities.values() {
            let Some(revocation_time) = identity.revoked else { continue };
            for serial in &identity.serials {
                revoked_certs.push(RevokedCertParams {
                    serial_number: SerialNumber::from_slice(&hex::decode(serial).context("serials")?),
                    revocation_time,
                    reason_code: None,
                    invalidity_date: None,
                });
            }
        }

        let now = OffsetDateTime::now_utc();
        let params = CertificateRevocationListParams {
            this_update: now - CLOCK_SKEW,
            next_update: now + Duration::days(CA_DAYS),
            crl_number: SerialNumber::from(self.identities.crl_number),
            issuing_distribution_point: None,
            revoked_certs,
            key_identifier_method: KeyIdMethod::Sha256,
        };
        Ok(params.signed_by(&self.issuer)?.pem()?)
    }
}

/// Validates an identity, `ROLE` or `ROLE.NAME`, which is also a folder's name.
///
/// # Errors
/// If the role is unknown, or the name is not 1 to 48 letters, digits, `-` and `_`.
pub(crate) fn check_identity(identity: &str) -> anyhow::Result<()> {
    let (role, name) = identity.split_once('.').map_or((identity, None), |(role, name)| (role, Some(name)));
    role.parse::<Role>()?;
    let plain = |name: &str| {
        let chars = name.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '-' | '_'));
        chars && (1..=48).contains(&name.len())
    };
    ensure!(
        name.is_none_or(plain),
        "identity: expected ROLE or ROLE.NAME, with a name of 1 to 48 letters, digits, - and _, got {identity:?}"
    );
    Ok(())
}

/// Creates the certificate and private key of an authority, in PEM.
fn new_ca() -> anyhow::Result<(String, String)> {
    let mut params = CertificateParams::new(Vec::new())?;
    let now = OffsetDateTime::now_utc();
    (params.not_before, params.not_after) = (now - CLOCK_SKEW, now + Duration::days(CA_DAYS));
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, "CPN authority");
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    let key = KeyPair::generate()?;
    Ok((params.self_signed(&key)?.pem(), key.serialize_pem()))
}
