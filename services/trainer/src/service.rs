//! The trainer's network face: demonstrations in, checkpoints out, training runs started, watched and stopped.

use crate::ingest::{Ingest, Limits};
use crate::publish;
use crate::recorder::{self, Recorder};
use crate::recordings::Recordings;
use crate::runs::{self, Runs};
use crate::runs_zenoh::{self, RunsZenoh};
use crate::versions::Versions;
use crate::{grpc, runs_metrics};
use anyhow::anyhow;
use serde::{Deserialize, Serialize};
use service_kit::access::Access;
use service_kit::changes::Changes;
use service_kit::session::Connection;
use service_kit::{GrpcServer, SessionConfig, metrics, session};
use std::net::{Ipv4Addr, SocketAddr};
use std::num::NonZeroU16;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinSet;
use tracing::info;
use wire::{access, key};
use zenoh::liveliness::LivelinessToken;

/// How long requests in flight may take to finish at shutdown.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(10);

/// What can be changed of a trainer.
pub(crate) const CHANGES: Changes = Changes {
    metric: "cpn_trainer_changes_refused_total",
    methods: &[("/cpn.v1.TrainerService/StartRun", "start_run"), ("/cpn.v1.TrainerService/StopRun", "stop_run")],
};

/// Settings of the service.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Names the trainer in its zenoh keys.
    pub name: String,
    /// Where episodes are kept.
    pub dataset: PathBuf,
    /// Whose checkpoints are published.
    pub checkpoints: PathBuf,
    /// Versions of a model that are kept.
    pub keep_versions: NonZeroU16,
    /// Folder of the training runs' folders.
    pub runs: PathBuf,
    /// Most training runs at the same time.
    pub max_runs: NonZeroU16,
    /// Where gRPC listens; port 0 takes a free one.
    pub grpc_listen: SocketAddr,
    /// Where Prometheus finds metrics; none are served if it is not given.
    pub metrics_listen: Option<SocketAddr>,
    /// What is started for a training run: this program, unless another embeds the service.
    #[serde(skip)]
    pub program: PathBuf,
    /// File of the tokens that clients of gRPC and metrics may bear instead of a certificate.
    pub tokens: Option<PathBuf>,
    /// How to join the others.
    pub session: SessionConfig,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            name: "trainer".into(),
            dataset: "data/demonstrations".into(),
            checkpoints: "runs/checkpoints".into(),
            keep_versions: const { NonZeroU16::new(5).expect("not zero") },
            runs: "runs/training".into(),
            max_runs: NonZeroU16::MIN,
            grpc_listen: (Ipv4Addr::LOCALHOST, 50052).into(),
            metrics_listen: None,
            program: std::env::current_exe().unwrap_or_else(|_| "cpn-trainer".into()),
            tokens: None,
            session: SessionConfig::default(),
        }
    }
}

/// A running service.
#[derive(Debug)]
pub struct Service {
    session: zenoh::Session,
    recorder: Recorder,
    runs: Runs,
    runs_zenoh: RunsZenoh,
    grpc: GrpcServer,
    tasks: JoinSet<anyhow::Result<()>>,
    connection: Connection,
    alive: LivelinessToken,
}

/// Starts the service; when this returns, it answers.
///
/// # Errors
/// If the dataset is mixed or cannot be read, the published versions cannot be read, an address cannot be listened on, the
/// session cannot be opened, or the name cannot stand in a key or is that of a running service.
pub async fn start(config: Config) -> anyhow::Result<Service> {
    let Config { name, dataset, checkpoints, keep_versions, runs, max_runs, program, .. } = config.clone();
    let network = &config.session;
    // All settings are checked before the first is acted upon.
    let token = key::trainer_alive(&name)?;
    let access = Access::new(network.tls()?.is_some(), config.tokens.as_deref())?;
    let listen = network.listen_at(config.grpc_listen, service_kit::grpc::MAX_CONNECTIONS)?;
    if let Some(address) = config.metrics_listen {
        let listen = network.listen_at(address, metrics::MAX_CONNECTIONS)?;
        metrics::serve(listen, access.clone(), access::may_scrape).await?;
    }
    let of_runs = runs::Config {
        folder: runs,
        dataset: dataset.clone(),
        checkpoints: checkpoints.clone(),
        max_runs: max_runs.get().into(),
        program,
    };
    let open = move || {
        let versions = Versions::open(checkpoints, keep_versions)?;
        anyhow::Ok((Arc::new(Recordings::open(dataset)?), Arc::new(versions), Runs::open(of_runs)?))
    };
    let (recordings, versions, runs) = tokio::task::spawn_blocking(open).await??;
    // Before the network is waited for, so that health tells of it.
    let mut grpc = grpc::start(runs.clone(), listen, access).await?;
    let session = session::open(network).await?;
    session::claim(&session, network, &token).await?;
    let connection = Connection::follow(&session, network);
    grpc.follow(connection.connected());
    let ingest = Arc::new(Ingest::new(Arc::clone(&recordings), Limits::default()));
    let recorder = recorder::start(&session, recordings, ingest).await.map_err(|e| anyhow!(e))?;
    let runs_zenoh = runs_zenoh::start(&session, &name, &runs).await?;
    let mut tasks = publish::start(&session, &versions).await?;
    let measured = runs.clone();
    tasks.spawn(async move {
        runs_metrics::follow(measured).await;
        Ok(())
    });
    let alive = session.liveliness().declare_token(token).await.map_err(|e| anyhow!(e))?;
    grpc.ready().await;
    info!(name, grpc = %grpc.address, "trainer is ready");
    Ok(Service { session, recorder, runs, runs_zenoh, grpc, tasks, connection, alive })
}

impl Service {
    /// The training runs, without a transport.
    pub fn runs(&self) -> Runs {
        self.runs.clone()
    }

    /// Where gRPC listens.
    pub fn grpc_address(&self) -> SocketAddr {
        self.grpc.address
    }

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

    /// Interrupts the training runs, which save their states, and leaves the network. Every episode that was acknowledged
    /// is on disk already.
    ///
    /// # Errors
    /// If gRPC had failed before, or the session does not close.
    pub async fn shutdown(mut self) -> anyhow::Result<()> {
        drop((self.connection, self.alive, self.recorder));
        self.runs.shutdown().await;
        // Who watches a run has seen its end; a client that keeps asking does not keep the service.
        let drained = tokio::time::timeout(DRAIN_TIMEOUT, self.grpc.drain()).await;
        drop(self.runs_zenoh);
        self.tasks.shutdown().await;
        self.session.close().await.map_err(|e| anyhow!(e))?;
        drained.unwrap_or(Ok(()))
    }
}
