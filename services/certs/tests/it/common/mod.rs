//! Test network with an authority and a router.

use certs::Authority;
use service_kit::SessionConfig;
use service_kit::session::Mode;
use std::collections::BTreeSet;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::Once;
use tempfile::TempDir;
use zenoh::Session;

/// A router with the generated configuration, and the files of every identity.
pub struct Network {
    pub folder: TempDir,
    pub port: u16,
    pub router: Session,
}

impl Network {
    pub async fn start() -> Self {
        // As in the programs, since zenoh's TLS links are safe on one thread only.
        static RUNTIME: Once = Once::new();
        #[expect(unsafe_code, reason = "set before zenoh reads it, and once")]
        RUNTIME.call_once(|| unsafe {
            std::env::set_var("ZENOH_RUNTIME", "(rx: (worker_threads: 1), tx: (handover: rx))");
        });
        let folder = tempfile::tempdir().unwrap();
        authority(folder.path()).init(&BTreeSet::new(), BTreeSet::new()).unwrap();
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let router = open_router(folder.path(), port).await;
        Self { folder, port, router }
    }

    /// Restarts the router with its current configuration.
    pub async fn restart(&mut self) {
        self.router.close().await.unwrap();
        self.router = open_router(self.folder.path(), self.port).await;
    }

    pub fn authority(&self) -> Authority {
        authority(self.folder.path())
    }

    pub fn files(&self, identity: &str) -> PathBuf {
        self.folder.path().join(identity)
    }

    pub fn config(&self, identity: &str) -> SessionConfig {
        config(&self.files(identity), self.port)
    }

    pub async fn session(&self, identity: &str) -> Session {
        service_kit::session::open(&self.config(identity)).await.unwrap()
    }
}

pub fn authority(folder: &Path) -> Authority {
    Authority::open(folder, 1).unwrap()
}

async fn open_router(folder: &Path, port: u16) -> Session {
    let mut config = zenoh::Config::from_file(folder.join("router/router.json5")).unwrap();
    config.insert_json5("listen/endpoints", &format!("[\"tls/127.0.0.1:{port}\"]")).unwrap();
    zenoh::open(config).await.unwrap()
}

/// A client of the router with the certificate in a folder.
pub fn config(files: &Path, port: u16) -> SessionConfig {
    SessionConfig {
        mode: Some(Mode::Client),
        connect: vec![format!("tls/localhost:{port}")],
        tls_ca: Some(files.join("ca.pem")),
        tls_certificate: Some(files.join("certificate.pem")),
        tls_private_key: Some(files.join("private-key.pem")),
        ..SessionConfig::default()
    }
}
