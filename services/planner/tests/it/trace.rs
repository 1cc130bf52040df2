//! Spans of a request, as exported to a collector.

#![expect(clippy::unwrap_used, reason = "tests")]

mod common;

use common::{PATIENCE, Process, plan_request};
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{TraceService, TraceServiceServer};
use opentelemetry_proto::tonic::collector::trace::v1::{ExportTraceServiceRequest, ExportTraceServiceResponse};
use opentelemetry_proto::tonic::trace::v1::Span;
use planner::model::RANDOM;
use prost::Message as _;
use service_kit::SessionConfig;
use std::net::TcpListener;
use std::process::Command;
use tokio::sync::mpsc;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status};
use wire::key;
use wire::proto::planner_service_client::PlannerServiceClient;

const TRACE: &str = "0af7651916cd43dd8448eb211c80319c";
const PARENT: &str = "b7ad6b7169203331";

struct Collector(mpsc::UnboundedSender<Span>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        let scopes = request.into_inner().resource_spans.into_iter().flat_map(|resource| resource.scope_spans);
        scopes.flat_map(|scope| scope.spans).for_each(|span| self.0.send(span).unwrap());
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

fn free() -> String {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string()
}

#[tokio::test(flavor = "multi_thread")]
async fn spans_follow_a_request_from_its_client() {
    let (sender, mut spans) = mpsc::unbounded_channel();
    let incoming = TcpIncoming::bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let collector = format!("http://{}", incoming.local_addr().unwrap());
    let server = tonic::transport::Server::builder().add_service(TraceServiceServer::new(Collector(sender)));
    tokio::spawn(server.serve_with_incoming(incoming));

    let (zenoh, grpc) = (format!("tcp/{}", free()), free());
    let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-planner"));
    let models = tempfile::tempdir().unwrap();
    command.arg("--models-dir").arg(models.path());
    command.args(["--listen", &zenoh, "--grpc-listen", &grpc, "--name", "traced"]);
    command.env("OTEL_EXPORTER_OTLP_ENDPOINT", collector).env("OTEL_BSP_SCHEDULE_DELAY", "100");
    let _process = Process(command.spawn().unwrap());
    let config = SessionConfig { connect: vec![zenoh], ..SessionConfig::default() };
    let session = service_kit::session::open(&config).await.unwrap();
    let alive = session.liveliness().declare_subscriber(key::planner_alive("traced").unwrap()).history(true);
    common::soon(alive.await.unwrap().recv_async()).await.unwrap();

    let traceparent = format!("00-{TRACE}-{PARENT}-01");
    let payload = plan_request(RANDOM, 1).encode_to_vec();
    let asked = session.get(key::planner_plan("traced").unwrap()).payload(payload).attachment(&traceparent);
    asked.await.unwrap().recv_async().await.unwrap().into_result().unwrap();
    assert_traced(&mut spans).await;

    let mut request = Request::new(plan_request(RANDOM, 1));
    request.metadata_mut().insert("traceparent", traceparent.parse().unwrap());
    PlannerServiceClient::connect(format!("http://{grpc}")).await.unwrap().plan(request).await.unwrap();
    assert_traced(&mut spans).await;

    // A malformed traceparent is ignored.
    let payload = plan_request(RANDOM, 1).encode_to_vec();
    let asked = session.get(key::planner_plan("traced").unwrap()).payload(payload).attachment("00-?");
    asked.await.unwrap().recv_async().await.unwrap().into_result().unwrap();
}

/// Waits for the spans of a request and its stages, each the child of the next, and all descendants of the client's.
async fn assert_traced(spans: &mut mpsc::UnboundedReceiver<Span>) {
    let mut found: Vec<Span> = Vec::new();
    while found.len() < 4 {
        let span = tokio::time::timeout(PATIENCE, spans.recv()).await.expect("four spans").unwrap();
        assert_eq!(hex::encode(&span.trace_id), TRACE, "{}", span.name);
        found.push(span);
    }
    let named = |name: &str| found.iter().find(|span| span.name == name).unwrap_or_else(|| panic!("no {name}"));
    let request = named("request");
    assert_eq!(hex::encode(&request.parent_span_id), PARENT);
    for stage in ["queue", "encode", "search"] {
        assert_eq!(named(stage).parent_span_id, request.span_id, "{stage}");
        assert!(named(stage).start_time_unix_nano >= request.start_time_unix_nano, "{stage}");
    }
}
