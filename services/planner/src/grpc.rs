//! The planner over gRPC: translation, health and reflection.

use crate::core::PlannerCore;
use anyhow::Context;
use std::future::{Future, ready};
use std::net::SocketAddr;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tonic::codegen::http;
use tonic::server::NamedService;
use tonic::service::Routes;
use tonic::transport::Server;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status};
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;
use tower::util::MapResponseLayer;
use wire::planner::{LoadModelRequest, PlanRequest};
use wire::proto::planner_service_server::{PlannerService, PlannerServiceServer};
use wire::{Error, Message, proto};

/// The one method whose requests are large has a limit of its own.
const LOAD_MODEL_PATH: &str = "/cpn.v1.PlannerService/LoadModel";

/// What health is asked for: the whole server and its one service.
const HEALTH_NAMES: [&str; 2] = ["", PlannerServiceServer::<Grpc>::NAME];

/// A gRPC server that runs.
#[derive(Debug)]
pub(crate) struct GrpcServer {
    /// Where it listens.
    pub(crate) address: SocketAddr,
    health: HealthReporter,
    stop: CancellationToken,
    task: AbortOnDropHandle<Result<(), tonic::transport::Error>>,
}

impl GrpcServer {
    /// Listens and answers. Health says "not serving" until [`GrpcServer::ready`].
    ///
    /// # Errors
    /// If the address cannot be listened on.
    pub(crate) async fn start(core: PlannerCore, listen: SocketAddr) -> anyhow::Result<Self> {
        let incoming = TcpIncoming::bind(listen).with_context(|| format!("gRPC on {listen}"))?.with_nodelay(Some(true));
        let address = incoming.local_addr()?;
        let (health, health_service) = tonic_health::server::health_reporter();
        set_health(&health, ServingStatus::NotServing).await;
        let reflection = tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(proto::DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
            .build_v1()?;
        let service = |limit| PlannerServiceServer::new(Grpc(core.clone())).max_decoding_message_size(limit);
        let planner = Routes::new(service(PlanRequest::MAX_BYTES))
            .into_axum_router()
            .route_service(LOAD_MODEL_PATH, service(LoadModelRequest::MAX_BYTES))
            .layer(MapResponseLayer::new(name_unreadable_payload));
        let routes = Routes::from(planner).add_service(health_service).add_service(reflection);
        let stop = CancellationToken::new();
        let stopped = stop.clone().cancelled_owned();
        let server = Server::builder().add_routes(routes).serve_with_incoming_shutdown(incoming, stopped);
        Ok(Self { address, health, stop, task: AbortOnDropHandle::new(tokio::spawn(server)) })
    }

    /// Lets health say "serving".
    pub(crate) async fn ready(&self) {
        set_health(&self.health, ServingStatus::Serving).await;
    }

    /// Takes no more requests and waits for those in flight.
    ///
    /// # Errors
    /// If the server had failed.
    pub(crate) async fn drain(&mut self) -> anyhow::Result<()> {
        set_health(&self.health, ServingStatus::NotServing).await;
        // Ends the streams that watch them, which would keep their connections open.
        for service in HEALTH_NAMES {
            self.health.clear_service_status(service).await;
        }
        self.stop.cancel();
        (&mut self.task).await?.context("gRPC")
    }
}

async fn set_health(health: &HealthReporter, status: ServingStatus) {
    for service in HEALTH_NAMES {
        health.set_service_status(service, status).await;
    }
}

/// The generated service, by the core.
struct Grpc(PlannerCore);

#[tonic::async_trait]
impl PlannerService for Grpc {
    async fn plan(&self, request: Request<proto::PlanRequest>) -> Result<Response<proto::PlanResponse>, Status> {
        answer(request, |request| self.0.plan(request)).await
    }

    async fn register_goal(
        &self,
        request: Request<proto::RegisterGoalRequest>,
    ) -> Result<Response<proto::RegisterGoalResponse>, Status> {
        answer(request, |request| ready(self.0.register_goal(request))).await
    }

    async fn load_model(
        &self,
        request: Request<proto::LoadModelRequest>,
    ) -> Result<Response<proto::LoadModelResponse>, Status> {
        answer(request, |request| self.0.load_model(request)).await
    }

    async fn list_models(
        &self,
        request: Request<proto::ListModelsRequest>,
    ) -> Result<Response<proto::ListModelsResponse>, Status> {
        answer(request, |_: wire::planner::ListModelsRequest| ready(Ok(self.0.list_models()))).await
    }
}

async fn answer<Q: Message, R: Message, F>(
    request: Request<Q::Proto>,
    serve: impl FnOnce(Q) -> F,
) -> Result<Response<R::Proto>, Status>
where
    F: Future<Output = Result<R, Error>>,
{
    let request = Q::try_from(request.into_inner())?;
    Ok(Response::new(serve(request).await?.into()))
}

/// Turns tonic's own refusals of a message, which come without details, into what the other transports answer: a
/// message that is too long or is not protobuf is the client's fault, not `INTERNAL`.
fn name_unreadable_payload<B>(mut response: http::Response<B>) -> http::Response<B> {
    let Some(status) = Status::from_header_map(response.headers()).filter(|status| status.details().is_empty()) else {
        return response;
    };
    let expected = match status.code() {
        tonic::Code::OutOfRange => "a shorter message",
        tonic::Code::Internal => "a protobuf message",
        _ => return response,
    };
    let explained = Status::from(Error::invalid("payload", expected, status.message()));
    if let Err(unsendable) = explained.add_header(response.headers_mut()) {
        tracing::warn!(%unsendable, "gRPC refusal sent without details");
    }
    response
}
