//! The trainer's network face: demonstrations in, checkpoints out.

use crate::ingest::{Ingest, Limits};
use crate::publish;
use crate::recorder::{self, Recorder};
use crate::recordings::Recordings;
use crate::versions::Versions;
use anyhow::anyhow;
use serde::{Deserialize, Serialize};
use service_kit::SessionConfig;
use std::num::NonZeroU16;
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
    /// Versions of a model that are kept.
    pub keep_versions: NonZeroU16,
    /// How to join the others.
    pub session: SessionConfig,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            dataset: "data/demonstrations".into(),
            checkpoints: "runs/checkpoints".into(),
            keep_versions: const { NonZeroU16::new(5).expect("not zero") },
            session: SessionConfig::default(),
        }
    }
}

/// A running service.
#[derive(Debug)]
pub struct Service {
    session: zenoh::Session,
    recorder: Recorder,
    tasks: JoinSet<anyhow::Result<()>>,
}

/// Starts the service; when this returns, it answers.
///
/// # Errors
/// If the dataset is mixed or cannot be read, the published versions cannot be read, or the session cannot be opened.
pub async fn start(config: Config) -> anyhow::Result<Service> {
    let Config { dataset, checkpoints, keep_versions, .. } = config;
    let recordings = Arc::new(tokio::task::spawn_blocking(move || Recordings::open(dataset)).await??);
    let versions = Arc::new(tokio::task::spawn_blocking(move || Versions::open(checkpoints, keep_versions)).await??);
    let session = service_kit::session::open(&config.session).await?;
    let ingest = Arc::new(Ingest::new(Arc::clone(&recordings), Limits::default()));
    let recorder = recorder::start(&session, recordings, ingest).await.map_err(|e| anyhow!(e))?;
    let tasks = publish::start(&session, &versions).await?;
    Ok(Service { session, recorder, tasks })
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
        drop(self.recorder);
        self.tasks.shutdown().await;
        self.session.close().await.map_err(|e| anyhow!(e))
    }
}
