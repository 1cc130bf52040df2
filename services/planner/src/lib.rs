//! Serves plans from trained weights over zenoh and gRPC, and to clients of openpi.
//!
//! [`core`] is the service; `grpc`, `zenoh` and `openpi` translate to it and nothing more. One thread (`model_thread`, `owner`)
//! owns every model ([`model`]) and plans together what waits together; goals are kept beside it (`goals`). A model is
//! replaced between two plans and only by one that has planned once already.

pub mod config;
pub mod core;
mod follow;
mod goals;
mod grpc;
mod load;
pub mod model;
mod model_thread;
mod openpi;
mod owner;
mod served;
mod task;
mod zenoh;

use crate::core::PlannerCore;
use crate::openpi::OpenpiServer;
use crate::zenoh::ZenohServer;
pub use config::Config;
#[doc(hidden)]
pub use openpi::request as openpi_request; // for the fuzzer
use service_kit::{GrpcServer, metrics};
use std::net::SocketAddr;
use std::time::Duration;
use tracing::{info, warn};

/// How long requests in flight may take to finish at shutdown.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(10);

/// A planner that runs.
#[derive(Debug)]
pub struct Planner {
    core: PlannerCore,
    grpc: GrpcServer,
    openpi: Option<OpenpiServer>,
    zenoh: ZenohServer,
}

/// Loads the models and serves them; when this returns, everything answers.
///
/// Wants tokio's multi-threaded runtime: zenoh panics on the other.
///
/// # Errors
/// If a checkpoint is faulty, an address cannot be listened on, the name cannot stand in a key, or metrics are asked for twice
/// in a process.
pub async fn start(config: Config) -> anyhow::Result<Planner> {
    if let Some(listen) = config.metrics_listen {
        metrics::serve(listen)?;
    }
    let core = PlannerCore::start(&config).await?;
    let grpc = grpc::start(core.clone(), config.grpc_listen).await?;
    let openpi = match config.openpi_listen {
        Some(listen) => Some(OpenpiServer::start(core.clone(), listen).await?),
        None => None,
    };
    let zenoh = ZenohServer::start(core.clone(), &config).await?;
    grpc.ready().await;
    let planner = Planner { core, grpc, openpi, zenoh };
    let (grpc, openpi) = (planner.grpc_address(), planner.openpi_address().map(tracing::field::display));
    info!(name = config.name, %grpc, openpi, "planner is ready");
    Ok(planner)
}

impl Planner {
    /// Where gRPC listens.
    pub fn grpc_address(&self) -> SocketAddr {
        self.grpc.address
    }

    /// Where clients of openpi are listened to, if they are.
    pub fn openpi_address(&self) -> Option<SocketAddr> {
        self.openpi.as_ref().map(|openpi| openpi.address)
    }

    /// The planner without a transport.
    pub fn core(&self) -> PlannerCore {
        self.core.clone()
    }

    /// Takes no more requests, lets those in flight finish within ten seconds, and leaves the network.
    ///
    /// # Errors
    /// If gRPC had failed before, or zenoh does not close.
    pub async fn shutdown(self) -> anyhow::Result<()> {
        let Self { core, mut grpc, openpi, mut zenoh } = self;
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
        drained.unwrap_or_else(|_| {
            warn!("requests in flight were given up after {} s", DRAIN_TIMEOUT.as_secs());
            Ok(())
        })
    }
}
