//! gRPC server with health and reflection services.

use crate::access::{Access, Peer, Refusal};
use crate::listener::{Connection, ListenConfig, Listener};
use anyhow::Context;
use axum::extract::Request;
use axum::middleware::{self, Next};
use axum::response::Response;
use futures::stream;
use std::net::SocketAddr;
use std::time::Duration;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tonic::Status;
use tonic::service::Routes;
use tonic::transport::Server;
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;

/// Health service name of the zenoh connection.
const ZENOH: &str = "zenoh";
/// Path of the health service, which orchestrators call without credentials.
const HEALTH: &str = "/grpc.health.v1.Health/";
/// Path of the reflection service, for every known identity.
const REFLECTION: &str = "/grpc.reflection.v1.ServerReflection/";
/// HTTP/2 keepalive: interval of silence before a ping, and timeout of its answer.
const KEEPALIVE: (Duration, Duration) = (Duration::from_secs(30), Duration::from_secs(10));
/// Maximum number of connections.
pub const MAX_CONNECTIONS: usize = 256;
/// Maximum number of concurrent streams per connection.
const MAX_STREAMS: u32 = 256;

/// Authorisation rule: whether an identity may call the method at a path.
pub type Allows = fn(identity: &str, path: &str) -> bool;

/// Running gRPC server.
#[derive(Debug)]
pub struct GrpcServer {
    /// Listening address.
    pub address: SocketAddr,
    health: HealthReporter,
    /// Names in the health service: the whole server, and its main service.
    names: [&'static str; 2],
    stop: CancellationToken,
    task: AbortOnDropHandle<Result<(), tonic::transport::Error>>,
    /// Task that reports the zenoh connection to the health service.
    network: Option<AbortOnDropHandle<()>>,
}

impl GrpcServer {
    /// Starts a server of `routes`, with those of its main service `name`, for clients that pass `access` and `allows`. `descriptors`
    /// is its encoded `FileDescriptorSet`, for reflection. Health is `NOT_SERVING` until [`GrpcServer::ready`].
    ///
    /// # Errors
    /// If the address cannot be listened on, or is beyond the loopback interface without TLS.
    pub async fn start(
        listen: ListenConfig,
        (access, allows): (Access, Allows),
        name: &'static str,
        descriptors: &[u8],
        routes: Routes,
    ) -> anyhow::Result<Self> {
        let listener = Listener::bind("gRPC", listen, &[b"h2"]).await?;
        let address = listener.address();

        let (health, health_service) = tonic_health::server::health_reporter();
        let reflection = tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(descriptors)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
            .build_v1()?;
        let routes = routes.add_service(health_service).add_service(reflection).into_axum_router();

        let check = move |request: Request, next: Next| {
            let checked = check(&access, allows, &request);
            async move {
                match checked {
                    Ok(()) => next.run(request).await,
                    Err(refusal) => refused(refusal),
                }
            }
        };
        let routes = Routes::from(routes.layer(middleware::from_fn(check)));

        let stop = CancellationToken::new();
        let stopped = stop.clone().cancelled_owned();
        let server = Server::builder()
            .http2_keepalive_interval(Some(KEEPALIVE.0))
            .http2_keepalive_timeout(Some(KEEPALIVE.1))
            .max_concurrent_streams(Some(MAX_STREAMS))
            .add_routes(routes)
            .serve_with_incoming_shutdown(incoming(listener), stopped);

        let names = ["", name];
        set_health(&health, names, ServingStatus::NotServing).await;
        health.set_service_status(ZENOH, ServingStatus::NotServing).await;
        let task = AbortOnDropHandle::new(tokio::spawn(server));
        Ok(Self { address, health, names, stop, task, network: None })
    }

    /// Reports the zenoh connection to the health service, under the name `zenoh`.
    pub fn follow(&mut self, mut connected: watch::Receiver<bool>) {
        let health = self.health.clone();
        self.network = Some(AbortOnDropHandle::new(tokio::spawn(async move {
            loop {
                let joined = *connected.borrow_and_update();
                let status = if joined { ServingStatus::Serving } else { ServingStatus::NotServing };
                health.set_service_status(ZENOH, status).await;
                if connected.changed().await.is_err() {
                    return;
                }
            }
        })));
    }

    /// Sets health to `SERVING`.
    pub async fn ready(&self) {
        set_health(&self.health, self.names, ServingStatus::Serving).await;
    }

    /// Stops accepting requests and waits for those in flight.
    ///
    /// # Errors
    /// If the server had failed.
    pub async fn drain(&mut self) -> anyhow::Result<()> {
        set_health(&self.health, self.names, ServingStatus::NotServing).await;
        self.network = None;
        // Ends clients' watch streams, which would keep their connections open.
        for name in self.names.into_iter().chain([ZENOH]) {
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

fn incoming(listener: Listener) -> impl stream::Stream<Item = std::io::Result<Connection>> {
    stream::unfold(listener, |mut listener| async move { Some((Ok(listener.next().await?), listener)) })
}

fn check(access: &Access, allows: Allows, request: &Request) -> Result<(), Refusal> {
    let path = request.uri().path();
    // Tonic adds the peer to the extensions of every request.
    let (false, Some(peer)) = (path.starts_with(HEALTH), request.extensions().get::<Peer>()) else {
        return Ok(());
    };
    let authorization = request.headers().get("authorization").and_then(|value| value.to_str().ok());
    access.check(peer, authorization, path, |identity| path.starts_with(REFLECTION) || allows(identity, path))
}

fn refused(refusal: Refusal) -> Response {
    let status = match refusal {
        Refusal::Forbidden => Status::permission_denied(refusal.to_string()),
        Refusal::Missing | Refusal::Unknown => Status::unauthenticated(refusal.to_string()),
    };
    status.into_http()
}
