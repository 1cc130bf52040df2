//! Serving gRPC, with health and reflection.

use anyhow::Context;
use std::net::SocketAddr;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tonic::service::Routes;
use tonic::transport::Server;
use tonic::transport::server::TcpIncoming;
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;

/// A gRPC server that runs.
#[derive(Debug)]
pub struct GrpcServer {
    /// Where it listens.
    pub address: SocketAddr,
    health: HealthReporter,
    /// What health is asked for: the whole server and its one service.
    names: [&'static str; 2],
    stop: CancellationToken,
    task: AbortOnDropHandle<Result<(), tonic::transport::Error>>,
}

impl GrpcServer {
    /// Listens and answers by the `routes` of the service of this name, which `descriptors`, an encoded
    /// `FileDescriptorSet`, describe. Health says "not serving" until [`GrpcServer::ready`].
    ///
    /// # Errors
    /// If the address cannot be listened on.
    pub async fn start(
        listen: SocketAddr,
        name: &'static str,
        descriptors: &[u8],
        routes: Routes,
    ) -> anyhow::Result<Self> {
        let incoming = TcpIncoming::bind(listen).with_context(|| format!("gRPC on {listen}"))?.with_nodelay(Some(true));
        let address = incoming.local_addr()?;
        let (health, health_service) = tonic_health::server::health_reporter();
        let reflection = tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(descriptors)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
            .build_v1()?;
        let routes = routes.add_service(health_service).add_service(reflection);
        let stop = CancellationToken::new();
        let stopped = stop.clone().cancelled_owned();
        let server = Server::builder().add_routes(routes).serve_with_incoming_shutdown(incoming, stopped);
        let names = ["", name];
        set_health(&health, names, ServingStatus::NotServing).await;
        Ok(Self { address, health, names, stop, task: AbortOnDropHandle::new(tokio::spawn(server)) })
    }

    /// Lets health say "serving".
    pub async fn ready(&self) {
        set_health(&self.health, self.names, ServingStatus::Serving).await;
    }

    /// Takes no more requests and waits for those in flight.
    ///
    /// # Errors
    /// If the server had failed.
    pub async fn drain(&mut self) -> anyhow::Result<()> {
        set_health(&self.health, self.names, ServingStatus::NotServing).await;
        // Ends the streams that watch them, which would keep their connections open.
        for name in self.names {
            self.health.clear_service_status(name).await;
        }
        self.stop.cancel();
        (&mut self.task).await?.context("gRPC")
    }
}

async fn set_health(health: &HealthReporter, names: [&'static str; 2], status: ServingStatus) {
    for name in names {
        health.set_service_status(name, status).await;
    }
}
