//! The trainer's network face: demonstrations in, checkpoints out.

use crate::ingest::{self, Ingest};
use crate::publish;
use anyhow::anyhow;
use serde::{Deserialize, Serialize};
use service_kit::SessionConfig;
use std::path::PathBuf;
use std::sync::Arc;
use tokio::task::JoinSet;

/// Settings of the service.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Where episodes are kept.
    pub dataset: PathBuf,
    /// Whose checkpoints are published.
    pub checkpoints: PathBuf,
    /// How to join the others.
    pub session: SessionConfig,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            dataset: "data/demonstrations".into(),
            checkpoints: "runs/checkpoints".into(),
            session: SessionConfig::default(),
        }
    }
}

/// A running service.
#[derive(Debug)]
pub struct Service {
    session: zenoh::Session,
    tasks: JoinSet<anyhow::Result<()>>,
}

/// Starts the service.
///
/// # Errors
/// If the session cannot be opened.
pub async fn start(config: Config) -> anyhow::Result<Service> {
    let session = service_kit::session::open(&config.session).await?;
    let mut tasks = JoinSet::new();
    let (receiver, publisher) = (session.clone(), session.clone());
    let kept = Arc::new(Ingest::new(config.dataset));
    tasks.spawn(async move { ingest::serve(&receiver, kept).await.map_err(|e| anyhow!(e)) });
    tasks.spawn(async move { publish::serve(&publisher, config.checkpoints).await });
    Ok(Service { session, tasks })
}

impl Service {
    /// Runs until a part of the service fails.
    ///
    /// # Errors
    /// Why it failed.
    pub async fn failed(&mut self) -> anyhow::Result<()> {
        match self.tasks.join_next().await {
            Some(result) => result?,
            None => Ok(()),
        }
    }

    /// Leaves the network. Every episode that was acknowledged is on disk already.
    ///
    /// # Errors
    /// If the session does not close.
    pub async fn shutdown(mut self) -> anyhow::Result<()> {
        self.tasks.shutdown().await;
        self.session.close().await.map_err(|e| anyhow!(e))
    }
}
