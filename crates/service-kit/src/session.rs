//! Opening a zenoh session.

use anyhow::{Context, anyhow};
use serde::{Deserialize, Serialize};
use serde_json::json;

/// How a process joins the others.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, clap::Args)]
#[serde(deny_unknown_fields, default)]
pub struct SessionConfig {
    /// Endpoints to connect to, for example tcp/127.0.0.1:7447.
    #[arg(long, env = "CPN_CONNECT", value_delimiter = ',', global = true)]
    pub connect: Vec<String>,
    /// Endpoints to listen on.
    #[arg(long, env = "CPN_LISTEN", value_delimiter = ',', default_value = "tcp/127.0.0.1:0", global = true)]
    pub listen: Vec<String>,
    /// Key prefix that keeps this run's messages apart from those of others.
    #[arg(long, env = "CPN_NAMESPACE", global = true)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub namespace: Option<String>,
}

impl Default for SessionConfig {
    fn default() -> Self {
        Self { connect: Vec::new(), listen: vec!["tcp/127.0.0.1:0".into()], namespace: None }
    }
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
    set("listen/endpoints", json!(config.listen))?;
    if let Some(namespace) = &config.namespace {
        set("namespace", json!(namespace))?;
    }
    zenoh::open(zenoh_config).await.map_err(|e| anyhow!(e)).context("opening the zenoh session")
}
