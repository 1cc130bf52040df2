//! Mutual TLS: one certificate authority per network, one certificate per process.

use anyhow::{Context, ensure};
use metrics::gauge;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{ClientConfig, RootCertStore, ServerConfig};
use tracing::warn;
use x509_parser::prelude::{FromDer, X509Certificate};

/// Remaining lifetime of a certificate below which a warning is logged.
const EXPIRES_SOON: Duration = Duration::from_secs(14 * 24 * 3600);

/// PEM files of a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tls {
    /// Certificate of the network's authority.
    pub ca: PathBuf,
    /// Certificate chain of this process.
    pub certificate: PathBuf,
    /// Private key of the certificate.
    pub private_key: PathBuf,
    /// Certificate revocation list of the authority.
    pub crl: Option<PathBuf>,
}

impl Tls {
    /// Server configuration with optional client certificates, which must be issued by the authority. Sets the gauge
    /// `cpn_certificate_expiry_timestamp_seconds`, and warns of a certificate that expires soon.
    ///
    /// # Errors
    /// If a file cannot be read or is invalid; the error names it.
    pub fn server(&self, protocols: &[&[u8]]) -> anyhow::Result<Arc<ServerConfig>> {
        let provider = Arc::new(ring::default_provider());
        let mut verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(self.roots()?), Arc::clone(&provider))
            .allow_unauthenticated();
        if let Some(crl) = &self.crl {
            let lists: Vec<CertificateRevocationListDer<'static>> = read_all("tls_crl", crl)?;
            verifier = verifier.with_crls(lists);
        }
        let verifier = verifier.build().with_context(|| named("tls_crl", self.crl.as_deref().unwrap_or(&self.ca)))?;

        let certificates = self.certificates()?;
        self.report_expiry(&certificates)?;
        let mut config = ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()?
            .with_client_cert_verifier(verifier)
            .with_single_cert(certificates, self.key()?)
            .with_context(|| named("tls_private_key", &self.private_key))?;
        config.alpn_protocols = protocols.iter().map(|protocol| protocol.to_vec()).collect();
        Ok(Arc::new(config))
    }

    /// Client configuration with a client certificate.
    ///
    /// # Errors
    /// If a file cannot be read or is invalid; the error names it.
    pub fn client(&self) -> anyhow::Result<ClientConfig> {
        ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()?
            .with_root_certificates(self.roots()?)
            .with_client_auth_cert(self.certificates()?, self.key()?)
            .with_context(|| named("tls_private_key", &self.private_key))
    }

    fn roots(&self) -> anyhow::Result<RootCertStore> {
        let mut roots = RootCertStore::empty();
        for certificate in read_all("tls_ca", &self.ca)? {
            roots.add(certificate).with_context(|| named("tls_ca", &self.ca))?;
        }
        Ok(roots)
    }

    fn certificates(&self) -> anyhow::Result<Vec<CertificateDer<'static>>> {
        read_all("tls_certificate", &self.certificate)
    }

    fn key(&self) -> anyhow::Result<PrivateKeyDer<'static>> {
        PrivateKeyDer::from_pem_file(&self.private_key).with_context(|| named("tls_private_key", &self.private_key))
    }

    fn report_expiry(&self, certificates: &[CertificateDer<'_>]) -> anyhow::Result<()> {
        for (name, certificate) in
            [("certificate", certificates.first()), ("ca", read_all("tls_ca", &self.ca)?.first())]
        {
            let Some(certificate) = certificate else { continue };
            let (_, certificate) =
                X509Certificate::from_der(certificate).with_context(|| named(name, &self.certificate))?;
            let expiry = certificate.validity().not_after.timestamp();
            gauge!("cpn_certificate_expiry_timestamp_seconds", "certificate" => name).set(expiry as f64);
            let expires = UNIX_EPOCH + Duration::from_secs(expiry.try_into().unwrap_or_default());
            if expires < SystemTime::now() + EXPIRES_SOON {
                let expires = certificate.validity().not_after;
                warn!(certificate = %self.certificate.display(), which = name, %expires, "a certificate expires soon");
            }
        }
        Ok(())
    }
}

/// All items of a kind in a PEM file, at least one.
fn read_all<T: PemObject>(setting: &str, file: &Path) -> anyhow::Result<Vec<T>> {
    let items = T::pem_file_iter(file).and_then(Iterator::collect::<Result<Vec<T>, _>>);
    let items = items.with_context(|| named(setting, file))?;
    ensure!(!items.is_empty(), "{}: expected PEM, got none", named(setting, file));
    Ok(items)
}

fn named(setting: &str, file: &Path) -> String {
    format!("{setting} {}", file.display())
}

/// Common name in a certificate.
pub(crate) fn common_name(certificate: &CertificateDer<'_>) -> Option<String> {
    let (_, certificate) = X509Certificate::from_der(certificate).ok()?;
    let name = certificate.subject().iter_common_name().next()?.as_str().ok()?.to_owned();
    Some(name)
}
