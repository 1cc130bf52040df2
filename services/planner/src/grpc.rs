//! gRPC transport of the planner.

use crate::CHANGES;
use crate::core::PlannerCore;
use crate::kserve::Inference;
use service_kit::GrpcServer;
use service_kit::access::Access;
use service_kit::listener::ListenConfig;
use std::future::ready;
use tonic::metadata::MetadataMap;
use tonic::server::NamedService;
use tonic::service::Routes;
use tonic::{Request, Response, Status};
use tower::util::MapResponseLayer;
use tracing::{Instrument, Span, debug_span};
use wire::access::may_call;
use wire::grpc::{answer, name_unreadable_payload};
use wire::inference::grpc_inference_service_server::GrpcInferenceServiceServer;
use wire::planner::{LoadModelRequest, PlanRequest};
use wire::proto::planner_service_server::{PlannerService, PlannerServiceServer};
use wire::trace::TRACEPARENT;
use wire::{Message, proto, trace};

/// Path of the only method with large requests, which has a size limit of its own.
const LOAD_MODEL_PATH: &str = "/cpn.v1.PlannerService/LoadModel";

/// Starts the gRPC server, whose health is `NOT_SERVING` until [`GrpcServer::ready`].
///
/// # Errors
/// If the address cannot be listened on, or is beyond the loopback interface without TLS.
pub(crate) async fn start(core: PlannerCore, listen: ListenConfig, access: Access) -> anyhow::Result<GrpcServer> {
    let service = |limit| PlannerServiceServer::new(Grpc(core.clone())).max_decoding_message_size(limit);
    let inference = GrpcInferenceServiceServer::new(Inference(core.clone()));
    let planner = Routes::new(service(PlanRequest::MAX_BYTES))
        .add_service(inference.max_decoding_message_size(PlanRequest::MAX_BYTES))
        .into_axum_router()
        .route_service(LOAD_MODEL_PATH, service(LoadModelRequest::MAX_BYTES))
        .layer(MapResponseLayer::new(name_unreadable_payload));
    let planner = CHANGES.watch(planner);
    let name = PlannerServiceServer::<Grpc>::NAME;
    GrpcServer::start(listen, (access, may_call), name, proto::DESCRIPTORS, Routes::from(planner)).await
}

/// Span of a request for a plan, in the trace of its client.
pub(crate) fn request_span(metadata: &MetadataMap, key: &'static str) -> Span {
    let span = debug_span!("request", otel.kind = "server", key);
    let parent = metadata.get(TRACEPARENT).and_then(|value| value.to_str().ok());
    trace::follow(&span, parent);
    span
}

/// Implementation of the generated service.
struct Grpc(PlannerCore);

#[tonic::async_trait]
impl PlannerService for Grpc {
    async fn plan(&self, request: Request<proto::PlanRequest>) -> Result<Response<proto::PlanResponse>, Status> {
        let span = request_span(request.metadata(), "PlannerService/Plan");
        answer(request, |request| self.0.plan(request)).instrument(span).await
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

    async fn unload_model(
        &self,
        request: Request<proto::UnloadModelRequest>,
    ) -> Result<Response<proto::UnloadModelResponse>, Status> {
        answer(request, |request| self.0.unload_model(request)).await
    }

    async fn list_models(
        &self,
        request: Request<proto::ListModelsRequest>,
    ) -> Result<Response<proto::ListModelsResponse>, Status> {
        answer(request, |_: wire::planner::ListModelsRequest| ready(Ok(self.0.list_models()))).await
    }
}
