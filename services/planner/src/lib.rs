//! Planner service: plans from trained weights over zenoh, gRPC, the Open Inference Protocol and openpi's protocol.
//!
//! [`core`] is the service without transports; `grpc`, `kserve`, `zenoh` and `openpi` only translate. One thread at a time (`model_thread`,
//! `owner`) owns all models ([`model`]) and plans queued requests in batches; `goals` stores the registered goals. A model is
//! swapped between two plans, and only for one that has been warmed up.

pub mod config;
pub mod core;
mod follow;
mod goals;
mod grpc;
mod kserve;
mod load;
pub mod model;
mod model_thread;
mod openpi;
mod outbox;
mod owner;
mod searches;
mod served;
mod signatures;
mod task;
mod zenoh;

use crate::core::PlannerCore;
use crate::openpi::OpenpiServer;
use crate::zenoh::ZenohServer;
pub use config::Config;
#[doc(hidden)]
pub use kserve::request as kserve_request; // for the fuzzer
#[doc(hidden)]
pub use openpi::request as openpi_request; // for the fuzzer
use service_kit::access::Access;
use service_kit::changes::Changes;
use service_kit::session::Connection;
use service_kit::{GrpcServer, metrics};
use std::net::SocketAddr;
use std::time::Duration;
use tracing::{info, warn};
use wire::access;

/// State-changing requests of a planner.
pub(crate) const CHANGES: Changes = Changes {
    metric: "cpn_planner_changes_refused_total",
    methods: &[
        ("/cpn.v1.PlannerService/LoadModel", "load_model"),
        ("/cpn.v1.PlannerService/UnloadModel", "unload_model"),
    ],
};

/// Timeout of requests in flight at shutdown, which then takes less than the ten seconds that orchestrators grant.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(7);

/// Running planner.
#[derive(Debug)]
pub struct Planner {
    core: PlannerCore,
    grpc: GrpcServer,
    openpi: Option<OpenpiServer>,
    zenoh: ZenohServer,
    connection: Connection,
}

/// Loads the models and serves them; when this returns, all transports answer.
///
/// Requires tokio's multi-threaded runtime: zenoh panics on the other.
///
/// # Errors
/// If a checkpoint is faulty, an address cannot be listened on, or is beyond the loopback interface without TLS, the name cannot
/// stand in a key or is that of a running planner, or metrics are asked for twice in a process.
pub async fn start(config: Config) -> anyhow::Result<Planner> {
    let session = &config.session;
    let access = Access::new(session.tls()?.is_some(), config.tokens.as_deref())?;
    if let Some(address) = config.metrics_listen {
        let listen = session.listen_at(address, metrics::MAX_CONNECTIONS)?;
        metrics::serve(listen, access.clone(), access::may_scrape).await?;
    }

    let core = PlannerCore::start(&config).await?;
    let listen = session.listen_at(config.grpc_listen, service_kit::grpc::MAX_CONNECTIONS)?;
    let mut grpc = grpc::start(core.clone(), listen, access.clone()).await?;
    let openpi = match config.openpi_listen {
        Some(address) => {
            let listen = session.listen_at(address, openpi::MAX_SOCKETS)?;
            Some(OpenpiServer::start(core.clone(), listen, access).await?)
        }
        None => None,
    };

    let zenoh = ZenohServer::start(core.clone(), &config).await?;
    let connection = zenoh.connection(session);
    grpc.follow(connection.connected());
    grpc.ready().await;

    let planner = Planner { core, grpc, openpi, zenoh, connection };
    let (grpc, openpi) = (planner.grpc_address(), planner.openpi_address().map(tracing::field::display));
    info!(name = config.name, %grpc, openpi, "planner is ready");
    Ok(planner)
}

impl Planner {
    /// Listening address of gRPC.
    pub fn grpc_address(&self) -> SocketAddr {
        self.grpc.address
    }

    /// Listening address for clients of openpi, if it is enabled.
    pub fn openpi_address(&self) -> Option<SocketAddr> {
        self.openpi.as_ref().map(|openpi| openpi.address)
    }

    /// Handle of the planner without transports.
    pub fn core(&self) -> PlannerCore {
        self.core.clone()
    }

    /// Stops accepting requests, lets those in flight finish within seven seconds, and closes the session.
    ///
    /// # Errors
    /// If gRPC had failed before, or the zenoh session cannot be closed.
    pub async fn shutdown(self) -> anyhow::Result<()> {
        let Self { core, mut grpc, openpi, mut zenoh, connection } = self;
        drop(connection);
        let drained = tokio::time::timeout(DRAIN_TIMEOUT, async {
            let openpi = async {
                if let Some(openpi) = openpi {
                    openpi.drain().await;
                }
            };
            let ((), grpc, ()) = tokio::join!(zenoh.drain(), grpc.drain(), openpi);
            core.stop().await;
            grpc
        })
        .await;

        zenoh.close().await?;
        // Searches still in progress have no client left.
        core.abort_searches();
        drained.unwrap_or_else(|_| {
            warn!("requests in flight were given up after {} s", DRAIN_TIMEOUT.as_secs());
            Ok(())
        })
    }
}
