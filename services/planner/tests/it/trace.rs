//! Spans of a request, as exported to a collector.

use crate::common::{NAME, PATIENCE, Program, plan_request};
use crate::kserve;
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{TraceService, TraceServiceServer};
use opentelemetry_proto::tonic::collector::trace::v1::{ExportTraceServiceRequest, ExportTraceServiceResponse};
use opentelemetry_proto::tonic::trace::v1::Span;
use planner::model::RANDOM;
use prost::Message as _;
use tokio::sync::mpsc;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status};
use wire::inference::grpc_inference_service_client::GrpcInferenceServiceClient;
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

#[tokio::test(flavor = "multi_thread")]
async fn spans_follow_a_request_from_its_client() {
    let (sender, mut spans) = mpsc::unbounded_channel();
    let incoming = TcpIncoming::bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let collector = format!("http://{}", incoming.local_addr().unwrap());
    let server = tonic::transport::Server::builder().add_service(TraceServiceServer::new(Collector(sender)));
    tokio::spawn(server.serve_with_incoming(incoming));

    let program = Program::start(&[], |command| {
        command.env("OTEL_EXPORTER_OTLP_ENDPOINT", collector).env("OTEL_BSP_SCHEDULE_DELAY", "100");
    })
    .await;
    let session = &program.session;

    let traceparent = format!("00-{TRACE}-{PARENT}-01");
    let payload = plan_request(RANDOM, 1).encode_to_vec();
    let asked = session.get(key::planner_plan(NAME).unwrap()).payload(payload).attachment(&traceparent);
    asked.await.unwrap().recv_async().await.unwrap().into_result().unwrap();
    assert_traced(&mut spans).await;

    let mut request = Request::new(plan_request(RANDOM, 1));
    request.metadata_mut().insert("traceparent", traceparent.parse().unwrap());
    PlannerServiceClient::new(program.channel.clone()).plan(request).await.unwrap();
    assert_traced(&mut spans).await;

    let mut request = Request::new(kserve::request(RANDOM, 1));
    request.metadata_mut().insert("traceparent", traceparent.parse().unwrap());
    GrpcInferenceServiceClient::new(program.channel.clone()).model_infer(request).await.unwrap();
    assert_traced(&mut spans).await;

    // A malformed traceparent is ignored.
    let payload = plan_request(RANDOM, 1).encode_to_vec();
    let asked = session.get(key::planner_plan(NAME).unwrap()).payload(payload).attachment("00-?");
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
