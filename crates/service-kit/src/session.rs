//! Opening a zenoh session.

use anyhow::{Context, anyhow};
use serde::{Deserialize, Serialize};
use serde_json::json;

/// How a process joins the others. What is left empty is not serialised, so that it can stand in a layer of
/// configuration and on a command line alike.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, clap::Args)]
#[serde(deny_unknown_fields, default)]
pub struct SessionConfig {
    /// Endpoints to connect to, for example tcp/127.0.0.1:7447.
    #[arg(long, env = "CPN_CONNECT", value_delimiter = ',')]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub connect: Vec<String>,
    /// Endpoints to listen on; any free port of the loopback interface if none is given.
    #[arg(long, env = "CPN_LISTEN", value_delimiter = ',')]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub listen: Vec<String>,
    /// Passes large payloads to processes on the same machine by shared memory; for sessions that stay, since zenoh keeps what
    /// ended ones shared.
    #[arg(long, env = "CPN_SHARED_MEMORY")]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub shared_memory: bool,
    /// Key prefix that keeps this run's messages apart from those of others.
    #[arg(long, env = "CPN_NAMESPACE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub namespace: Option<String>,
}

/// Opens a session in peer mode. Peers find each other by gossip from one known endpoint, never by multicast, which
/// fails without a word in containers. An endpoint that is not up yet is tried again for as long as the session lives.
///
/// # Errors
/// If an endpoint is malformed or cannot be listened on.
pub async fn open(config: &SessionConfig) -> anyhow::Result<zenoh::Session> {
    let mut zenoh_config = zenoh::Config::default();
    let mut set = |key: &str, value: serde_json::Value| {
        zenoh_config.insert_json5(key, &value.to_string()).map_err(|e| anyhow!("zenoh {key} = {value}: {e}"))
    };
    set("mode", json!("peer"))?;
    set("scouting/multicast/enabled", json!(false))?;
    set("scouting/gossip/enabled", json!(true))?;
    set("connect/endpoints", json!(config.connect))?;
    set("connect/timeout_ms", json!(-1))?;
    set("connect/exit_on_failure", json!(false))?;
    let any_port = ["tcp/127.0.0.1:0".to_owned()];
    set("listen/endpoints", json!(if config.listen.is_empty() { &any_port[..] } else { &config.listen[..] }))?;
    set("transport/shared_memory/enabled", json!(config.shared_memory))?;
    if let Some(namespace) = &config.namespace {
        set("namespace", json!(namespace))?;
    }
    zenoh::open(zenoh_config).await.map_err(|e| anyhow!(e)).context("opening the zenoh session")
}
