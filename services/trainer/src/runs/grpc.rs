//! gRPC transport of training runs.

use crate::runs::Runs;
use crate::service::CHANGES;
use futures::StreamExt;
use futures::stream::BoxStream;
use service_kit::GrpcServer;
use service_kit::access::Access;
use service_kit::listener::ListenConfig;
use tonic::server::NamedService;
use tonic::service::Routes;
use tonic::{Request, Response, Status};
use tower::util::MapResponseLayer;
use wire::access::may_call;
use wire::grpc::{answer, name_unreadable_payload};
use wire::proto::trainer_service_server::{TrainerService, TrainerServiceServer};
use wire::training::{
    ListRunsRequest, ListRunsResponse, StartRunRequest, StartRunResponse, StopRunRequest, StopRunResponse,
    WatchRunRequest, WatchRunResponse,
};
use wire::{Code, Error, Message, proto};

/// Starts the gRPC server, whose health is `NOT_SERVING` until [`GrpcServer::ready`].
///
/// # Errors
/// If the address cannot be listened on, or is beyond the loopback interface without TLS.
pub(crate) async fn start(runs: Runs, listen: ListenConfig, access: Access) -> anyhow::Result<GrpcServer> {
    let service = TrainerServiceServer::new(Grpc(runs)).max_decoding_message_size(StartRunRequest::MAX_BYTES);
    let routes = Routes::new(service).into_axum_router().layer(MapResponseLayer::new(name_unreadable_payload));
    let routes = CHANGES.watch(routes);
    let name = TrainerServiceServer::<Grpc>::NAME;
    GrpcServer::start(listen, (access, may_call), name, proto::DESCRIPTORS, Routes::from(routes)).await
}

/// Implementation of the generated service.
struct Grpc(Runs);

#[tonic::async_trait]
impl TrainerService for Grpc {
    type WatchRunStream = BoxStream<'static, Result<proto::WatchRunResponse, Status>>;

    async fn start_run(
        &self,
        request: Request<proto::StartRunRequest>,
    ) -> Result<Response<proto::StartRunResponse>, Status> {
        let runs = self.0.clone();
        let start = |request: StartRunRequest| async move {
            let starting = tokio::task::spawn_blocking(move || runs.start(&request));
            let run = starting.await.map_err(|e| Error::new(Code::Internal, "name", "a run that starts", e))??;
            Ok(StartRunResponse { run })
        };
        answer(request, start).await
    }

    async fn stop_run(
        &self,
        request: Request<proto::StopRunRequest>,
    ) -> Result<Response<proto::StopRunResponse>, Status> {
        let stop =
            |request: StopRunRequest| async move { Ok(StopRunResponse { run: self.0.stop(&request.name).await? }) };
        answer(request, stop).await
    }

    async fn list_runs(
        &self,
        request: Request<proto::ListRunsRequest>,
    ) -> Result<Response<proto::ListRunsResponse>, Status> {
        answer(request, |_: ListRunsRequest| async { Ok(ListRunsResponse { runs: self.0.list() }) }).await
    }

    async fn watch_run(
        &self,
        request: Request<proto::WatchRunRequest>,
    ) -> Result<Response<Self::WatchRunStream>, Status> {
        let request = WatchRunRequest::try_from(request.into_inner())?;
        let runs = self.0.watch(&request.name)?;
        Ok(Response::new(runs.map(|run| Ok(WatchRunResponse { run }.into())).boxed()))
    }
}
