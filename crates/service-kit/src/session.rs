//! Zenoh session: configuration, opening, and monitoring of the connection.

use crate::listener::{self, ListenConfig};
use crate::process::ZENOH_RUNTIME;
use crate::tls::Tls;
use anyhow::{Context, anyhow, bail, ensure};
use clap::builder::FalseyValueParser;
use metrics::gauge;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use tokio::sync::{oneshot, watch};
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::task::AbortOnDropHandle;
use tracing::{info, warn};
use zenoh::{Session, Wait};

/// Interval of the warning that nothing is connected.
const REMINDER: Duration = Duration::from_secs(5);
/// Pause of a client between two tries of its routers.
const RETRY: Duration = Duration::from_secs(1);
/// Interval of checks of the connection.
const CHECK_INTERVAL: Duration = Duration::from_millis(500);
/// Largest message after defragmentation, in bytes: a request to load a model may carry its checkpoint.
const MAX_MESSAGE_BYTES: usize = 66 << 20;

/// Role of a session in its network.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// Direct connections to other peers, found by gossip.
    #[default]
    Peer,
    /// One connection, to a router.
    Client,
    /// Connections of other sessions, between which it routes messages.
    Router,
}

/// Connection to the zenoh network. Empty fields are not serialised, so that they leave lower layers of the configuration as
/// they are.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, clap::Args)]
#[serde(deny_unknown_fields, default)]
pub struct SessionConfig {
    /// Zenoh mode [default: peer].
    #[arg(long, env = "CPN_MODE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mode: Option<Mode>,
    /// Endpoints to connect to, for example tcp/127.0.0.1:7447 or tls/router:7447.
    #[arg(long, env = "CPN_CONNECT", value_delimiter = ',')]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub connect: Vec<String>,
    /// Endpoints to listen on [default: any free port of the loopback interface; none for a client].
    #[arg(long, env = "CPN_LISTEN", value_delimiter = ',')]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub listen: Vec<String>,
    /// Shared memory for large payloads between processes of one machine. Only for long-lived sessions: zenoh never unmaps what
    /// closed sessions shared.
    #[arg(long, env = "CPN_SHARED_MEMORY", value_parser = FalseyValueParser::new())]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub shared_memory: bool,
    /// Prefix of every key, which separates runs that share a network.
    #[arg(long, env = "CPN_NAMESPACE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub namespace: Option<String>,
    /// Zenoh configuration file, in place of the defaults here; options on the command line win over it.
    #[arg(long, env = "ZENOH_CONFIG", value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zenoh_config: Option<PathBuf>,
    /// User name for routers that ask for one.
    #[arg(long, env = "CPN_USER", requires = "password_file")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// File with the user's password.
    #[arg(long, env = "CPN_PASSWORD_FILE", value_name = "FILE", requires = "user")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// Certificate of the network's authority, in PEM.
    #[arg(long, env = "CPN_TLS_CA", value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_ca: Option<PathBuf>,
    /// Certificate of this process, in PEM, for connections of either direction.
    #[arg(long, env = "CPN_TLS_CERTIFICATE", value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_certificate: Option<PathBuf>,
    /// Private key of the certificate, in PEM.
    #[arg(long, env = "CPN_TLS_PRIVATE_KEY", value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_private_key: Option<PathBuf>,
    /// List of the authority's revoked certificates, in PEM, for gRPC, openpi and metrics.
    #[arg(long, env = "CPN_TLS_CRL", value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls_crl: Option<PathBuf>,
    /// Listen beyond the loopback interface without TLS.
    #[arg(long, env = "CPN_INSECURE", value_parser = FalseyValueParser::new())]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub insecure: bool,
}

impl SessionConfig {
    /// TLS files, if they are set.
    ///
    /// # Errors
    /// If only some of authority, certificate and private key are given.
    pub fn tls(&self) -> anyhow::Result<Option<Tls>> {
        match (&self.tls_ca, &self.tls_certificate, &self.tls_private_key) {
            (None, None, None) => {
                ensure!(
                    self.tls_crl.is_none(),
                    "tls_crl: expected tls_ca, tls_certificate and tls_private_key with it"
                );
                Ok(None)
            }
            (Some(ca), Some(certificate), Some(private_key)) => Ok(Some(Tls {
                ca: ca.clone(),
                certificate: certificate.clone(),
                private_key: private_key.clone(),
                crl: self.tls_crl.clone(),
            })),
            (ca, certificate, private_key) => {
                let got = [("tls_ca", ca), ("tls_certificate", certificate), ("tls_private_key", private_key)];
                let missing: Vec<_> = got.iter().filter(|(_, file)| file.is_none()).map(|(name, _)| *name).collect();
                bail!("{}: expected a file, as other TLS files are given, got none", missing.join(", "))
            }
        }
    }

    /// Settings of a listener at an address, with the same TLS files as zenoh.
    ///
    /// # Errors
    /// If only some of authority, certificate and private key are given.
    pub fn listen_at(&self, address: SocketAddr, max_connections: usize) -> anyhow::Result<ListenConfig> {
        Ok(ListenConfig { address, tls: self.tls()?, insecure: self.insecure, max_connections })
    }

    /// Zenoh's configuration.
    ///
    /// # Errors
    /// If a setting is malformed, a file cannot be read, or an endpoint listens beyond the loopback interface in plain text.
    pub fn zenoh(&self) -> anyhow::Result<zenoh::Config> {
        let mut zenoh = match &self.zenoh_config {
            Some(file) => {
                zenoh::Config::from_file(file).map_err(|e| anyhow!("zenoh_config {}: {e}", file.display()))?
            }
            None => defaults()?,
        };

        if let Some(mode) = self.mode {
            set(&mut zenoh, "mode", json!(mode))?;
        }
        for (key, endpoints) in [("connect/endpoints", &self.connect), ("listen/endpoints", &self.listen)] {
            // A list may end in a comma.
            let endpoints: Vec<_> = endpoints.iter().filter(|endpoint| !endpoint.is_empty()).collect();
            if !endpoints.is_empty() {
                set(&mut zenoh, key, json!(endpoints))?;
            }
        }

        if self.shared_memory || self.zenoh_config.is_none() {
            set(&mut zenoh, "transport/shared_memory/enabled", json!(self.shared_memory))?;
        }
        if let Some(namespace) = &self.namespace {
            set(&mut zenoh, "namespace", json!(namespace))?;
        }

        if let (Some(user), Some(file)) = (&self.user, &self.password_file) {
            let password =
                std::fs::read_to_string(file).with_context(|| format!("password_file {}", file.display()))?;
            set(&mut zenoh, "transport/auth/usrpwd/user", json!(user))?;
            // Zenoh's error of an invalid value would quote the password.
            zenoh
                .insert_json5("transport/auth/usrpwd/password", &json!(password.trim_end_matches('\n')).to_string())
                .map_err(|_| anyhow!("password_file {}: expected a password, got none", file.display()))?;
        }

        if let Some(tls) = self.tls()? {
            if std::env::var_os(ZENOH_RUNTIME).is_none() {
                warn!("{ZENOH_RUNTIME} is not set: zenoh's TLS links are not safe on several threads");
            }
            // Checked here, since zenoh reports a faulty file only as a router that does not answer.
            tls.client()?;
            for (key, file) in [
                ("root_ca_certificate", &tls.ca),
                ("listen_certificate", &tls.certificate),
                ("connect_certificate", &tls.certificate),
                ("listen_private_key", &tls.private_key),
                ("connect_private_key", &tls.private_key),
            ] {
                set(&mut zenoh, &format!("transport/link/tls/{key}"), json!(file))?;
            }
            set(&mut zenoh, "transport/link/tls/enable_mtls", json!(true))?;
            set(&mut zenoh, "transport/link/tls/close_link_on_expiration", json!(true))?;
        }

        self.check_endpoints(&zenoh)?;
        Ok(zenoh)
    }

    /// Whether a connection is expected: there are endpoints to connect to, or the mode is client.
    pub(crate) fn expects_connection(&self) -> bool {
        let seeks = || {
            let zenoh = self.zenoh()?;
            let connect = endpoints(&zenoh, "connect/endpoints", &mode(&zenoh)?)?;
            anyhow::Ok(!connect.is_empty() || get(&zenoh, "mode")? == json!("client"))
        };
        seeks().unwrap_or(true)
    }

    /// Refuses endpoints that listen beyond the loopback interface in plain text, and a client without a router.
    fn check_endpoints(&self, zenoh: &zenoh::Config) -> anyhow::Result<()> {
        let mode = mode(zenoh)?;
        if mode == "client" && endpoints(zenoh, "connect/endpoints", &mode)?.is_empty() {
            let scouts = get(zenoh, "scouting/multicast/enabled")? == json!(true);
            ensure!(scouts, "connect: expected the endpoint of a router, as the mode is client, got none");
        }
        for endpoint in endpoints(zenoh, "listen/endpoints", &mode)? {
            let (protocol, address) = endpoint.split_once('/').unwrap_or((&endpoint, ""));
            let encrypted = matches!(protocol, "tls" | "quic");
            let local = protocol.starts_with("unix") || listener::is_loopback(address);
            ensure!(
                encrypted || local || self.insecure,
                "listen: expected a tls/ endpoint beyond the loopback interface, or insecure to be set, got {endpoint}"
            );
        }
        Ok(())
    }
}

/// Zenoh's configuration without settings. Peers find each other by gossip from one known endpoint, never by multicast, which
/// fails silently in containers. An endpoint that is not up yet is retried for as long as the session lives.
fn defaults() -> anyhow::Result<zenoh::Config> {
    let mut zenoh = zenoh::Config::default();
    set(&mut zenoh, "mode", json!("peer"))?;
    set(&mut zenoh, "scouting/multicast/enabled", json!(false))?;
    set(&mut zenoh, "scouting/gossip/enabled", json!(true))?;
    // With a timeout of its own, a client would try its first endpoint for ever, and no other.
    set(&mut zenoh, "connect/timeout_ms", json!({"router": -1, "peer": -1, "client": 0}))?;
    set(&mut zenoh, "connect/exit_on_failure", json!(false))?;
    set(
        &mut zenoh,
        "connect/retry",
        json!({"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}),
    )?;
    let any_port = json!(["tcp/127.0.0.1:0"]);
    set(&mut zenoh, "listen/endpoints", json!({"peer": any_port, "router": any_port, "client": []}))?;
    set(&mut zenoh, "transport/link/rx/max_message_size", json!(MAX_MESSAGE_BYTES))?;
    Ok(zenoh)
}

fn set(config: &mut zenoh::Config, key: &str, value: Value) -> anyhow::Result<()> {
    config.insert_json5(key, &value.to_string()).map_err(|e| anyhow!("zenoh {key} = {value}: {e}"))
}

fn get(config: &zenoh::Config, key: &str) -> anyhow::Result<Value> {
    let text = config.get_json(key).map_err(|e| anyhow!("zenoh {key}: {e}"))?;
    serde_json::from_str(&text).with_context(|| format!("zenoh {key}"))
}

fn mode(config: &zenoh::Config) -> anyhow::Result<String> {
    Ok(get(config, "mode")?.as_str().unwrap_or("peer").to_owned())
}

/// Endpoints of a mode: zenoh has one list for all modes, or one for each.
fn endpoints(config: &zenoh::Config, key: &str, mode: &str) -> anyhow::Result<Vec<String>> {
    fn collect(value: &Value, found: &mut Vec<String>) {
        match value {
            Value::String(endpoint) => found.push(endpoint.clone()),
            Value::Array(values) => values.iter().for_each(|value| collect(value, found)),
            _ => (),
        }
    }

    let value = get(config, key)?;
    let of_mode = value.get(mode).unwrap_or(&value);
    let mut found = Vec::new();
    collect(of_mode, &mut found);
    Ok(found)
}

/// Conversion of zenoh's errors, which are boxed and therefore not converted by `?`.
pub trait IntoAnyhow<T> {
    /// The result with an error of `anyhow`.
    ///
    /// # Errors
    /// Zenoh's error.
    fn into_anyhow(self) -> anyhow::Result<T>;
}

impl<T> IntoAnyhow<T> for zenoh::Result<T> {
    fn into_anyhow(self) -> anyhow::Result<T> {
        self.map_err(anyhow::Error::from_boxed)
    }
}

/// Opens a session. A client waits for its router, with a warning every few seconds.
///
/// # Errors
/// If a setting is malformed, a file cannot be read, an endpoint cannot be listened on, or listens beyond the loopback
/// interface in plain text.
pub async fn open(config: &SessionConfig) -> anyhow::Result<Session> {
    let zenoh = config.zenoh()?;
    let reached = endpoints(&zenoh, "connect/endpoints", &mode(&zenoh)?)?.join(", ");
    let is_client = mode(&zenoh)? == "client";

    // On a thread of its own, since zenoh blocks in a single poll while it connects.
    let (sender, mut opened) = oneshot::channel();
    let open = move || {
        loop {
            let session = zenoh::open(zenoh.clone()).wait();
            if session.is_ok() || !is_client || sender.is_closed() {
                return drop(sender.send(session));
            }
            std::thread::sleep(RETRY);
        }
    };
    std::thread::Builder::new().name("zenoh-open".into()).spawn(open)?;

    let mut reminder = interval(REMINDER);
    reminder.tick().await;
    loop {
        tokio::select! {
            session = &mut opened => return session?.into_anyhow().context("opening the zenoh session"),
            _ = reminder.tick() => warn!(endpoints = reached, "no router answers; trying again"),
        }
    }
}

/// Whether a router or a peer is connected.
pub async fn is_connected(session: &Session) -> bool {
    let info = session.info();
    info.routers_zid().await.next().is_some() || info.peers_zid().await.next().is_some()
}

/// Monitor of a session's connection.
#[derive(Debug)]
pub struct Connection {
    connected: watch::Receiver<bool>,
    _task: AbortOnDropHandle<()>,
}

impl Connection {
    /// Monitors a session: warns every few seconds while nothing is connected, and sets the gauge `cpn_zenoh_connected`. A
    /// session without anything to connect to counts as connected.
    pub fn follow(session: &Session, config: &SessionConfig) -> Self {
        let (state, connected) = watch::channel(true);
        let (session, standalone) = (session.clone(), !config.expects_connection());
        let task = AbortOnDropHandle::new(tokio::spawn(async move {
            let mut check = interval(CHECK_INTERVAL);
            check.set_missed_tick_behavior(MissedTickBehavior::Skip);
            let mut reminded = None;
            while !session.is_closed() {
                check.tick().await;
                let connected = standalone || is_connected(&session).await;
                gauge!("cpn_zenoh_connected").set(if connected { 1.0 } else { 0.0 });
                let changed = state.send_if_modified(|state| std::mem::replace(state, connected) != connected);

                if connected {
                    if changed {
                        info!("connected to the zenoh network again");
                    }
                    reminded = None;
                } else if reminded.is_none_or(|last: Instant| last.elapsed() >= REMINDER) {
                    warn!("no router or peer is connected; trying again");
                    reminded = Some(Instant::now());
                }
            }
        }));
        Self { connected, _task: task }
    }

    /// Whether a router or peer is connected, and each change of it.
    pub fn connected(&self) -> watch::Receiver<bool> {
        self.connected.clone()
    }
}
