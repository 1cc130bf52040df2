//! Trainer service: records demonstrations, publishes checkpoints, and starts, watches and stops training runs.

use crate::publish::versions::Versions;
use crate::publish::{self, Publisher};
use crate::record::folder::Recordings;
use crate::record::ingest::{Ingest, Limits};
use crate::record::{self, Recorder};
use crate::runs::zenoh::RunsZenoh;
use crate::runs::{self, Runs};
use serde::{Deserialize, Serialize};
use service_kit::access::Access;
use service_kit::changes::Changes;
use service_kit::network;
use service_kit::session::{Connection, IntoAnyhow};
use service_kit::{GrpcServer, SessionConfig, config, metrics, session};
use std::net::SocketAddr;
use std::num::NonZeroU16;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tracing::info;
use wire::{access, key};
use zenoh::liveliness::LivelinessToken;

/// Timeout of requests in flight at shutdown, after training runs have saved their states; the rest of it then takes less than
/// ten seconds.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(7);

/// Maximum number of concurrent queries of each kind; each holds at most one episode in memory.
pub(crate) const PLACES: usize = 16;

/// State-changing requests of a trainer.
pub(crate) const CHANGES: Changes = Changes {
    metric: "cpn_trainer_changes_refused_total",
    methods: &[("/cpn.v1.TrainerService/StartRun", "start_run"), ("/cpn.v1.TrainerService/StopRun", "stop_run")],
};

/// Settings of the service: options of its command line, and keys of its configuration file.
#[derive(Debug, Clone, Serialize, Deserialize, clap::Args)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Name of the trainer in its zenoh keys.
    #[arg(long, default_value = "trainer")]
    pub name: String,
    /// Folder of the recorded demonstrations.
    #[arg(long, value_name = "FOLDER", default_value = "data/demonstrations")]
    pub dataset: PathBuf,
    /// Folder of the checkpoints to publish.
    #[arg(long, value_name = "FOLDER", default_value = "runs/checkpoints")]
    pub checkpoints: PathBuf,
    /// Maximum number of a model's versions kept; the oldest are removed.
    #[arg(long, value_name = "COUNT", default_value = "5")]
    pub keep_versions: NonZeroU16,
    /// Folder of the training runs, a folder for each.
    #[arg(long, value_name = "FOLDER", default_value = "runs/training")]
    pub runs: PathBuf,
    /// Maximum number of training runs at the same time; one more is refused.
    #[arg(long, value_name = "COUNT", default_value = "1")]
    pub max_runs: NonZeroU16,
    /// Listening address of gRPC; port 0 takes a free one.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:50052")]
    pub grpc_listen: SocketAddr,
    /// Listening address for Prometheus, for example 127.0.0.1:9464 [default: none].
    #[arg(long, value_name = "ADDRESS")]
    pub metrics_listen: Option<SocketAddr>,
    /// Program of a training run: this one, unless another embeds the service.
    #[arg(skip = this_program())]
    #[serde(skip, default = "this_program")]
    pub program: PathBuf,
    /// File of tokens that clients of gRPC and metrics may send instead of a certificate [default: none].
    #[arg(long, env = "CPN_TOKENS", value_name = "FILE")]
    pub tokens: Option<PathBuf>,
    /// Connection to the zenoh network.
    #[command(flatten)]
    pub session: SessionConfig,
}

impl Default for Config {
    fn default() -> Self {
        config::defaults()
    }
}

fn this_program() -> PathBuf {
    std::env::current_exe().unwrap_or_else(|_| "cpn-trainer".into())
}

/// Running service.
#[derive(Debug)]
pub struct Service {
    session: zenoh::Session,
    recorder: Recorder,
    runs: Runs,
    runs_zenoh: RunsZenoh,
    grpc: GrpcServer,
    publisher: Publisher,
    connection: Connection,
    alive: LivelinessToken,
}

/// Starts the service; when this returns, all transports answer.
///
/// # Errors
/// If the dataset cannot be read or has several render specs, the published versions cannot be read, an address cannot be
/// listened on, the session cannot be opened, or the name is not valid in a key or is that of a running service.
pub async fn start(config: Config) -> anyhow::Result<Service> {
    let Config { name, dataset, checkpoints, keep_versions, runs, max_runs, program, .. } = config.clone();
    let network = &config.session;
    // Checked before anything starts.
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

    // Before the session, so that health reports a missing connection.
    let mut grpc = runs::grpc::start(runs.clone(), listen, access).await?;
    let session = session::open(network).await?;
    let claimed = network::claim(&session, network, token).await?;
    let connection = Connection::follow(&session, network);
    grpc.follow(connection.connected());

    let ingest = Arc::new(Ingest::new(Arc::clone(&recordings), Limits::default()));
    let recorder = record::start(&session, recordings, ingest).await?;
    let runs_zenoh = runs::zenoh::start(&session, &name, &runs).await?;
    let mut publisher = publish::start(&session, &versions).await?;
    let measured = runs.clone();
    publisher.tasks.spawn(async move {
        runs::metrics::follow(measured).await;
        Ok(())
    });

    let alive = claimed.alive().await?;
    grpc.ready().await;
    info!(name, grpc = %grpc.address, "trainer is ready");
    Ok(Service { session, recorder, runs, runs_zenoh, grpc, publisher, connection, alive })
}

impl Service {
    /// Registry of training runs, without transports.
    pub fn runs(&self) -> Runs {
        self.runs.clone()
    }

    /// Listening address of gRPC.
    pub fn grpc_address(&self) -> SocketAddr {
        self.grpc.address
    }

    /// Waits until a task of the service fails.
    ///
    /// # Errors
    /// The error of the failed task.
    pub async fn failed(&mut self) -> anyhow::Result<()> {
        match self.publisher.tasks.join_next().await {
            Some(result) => result?,
            None => Ok(()),
        }
    }

    /// Interrupts the training runs, which save their states, and closes the session. Acknowledged episodes are on disk already.
    ///
    /// # Errors
    /// If gRPC had failed before, or the session cannot be closed.
    pub async fn shutdown(mut self) -> anyhow::Result<()> {
        drop((self.connection, self.alive, self.recorder));
        self.runs.shutdown().await;
        // Watchers of a run have seen its end; clients with long requests are cut off.
        let drained = tokio::time::timeout(DRAIN_TIMEOUT, self.grpc.drain()).await;
        drop(self.runs_zenoh);
        self.publisher.tasks.shutdown().await;
        self.session.close().await.into_anyhow()?;
        drained.unwrap_or(Ok(()))
    }
}
