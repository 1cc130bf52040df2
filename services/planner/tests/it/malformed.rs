//! Malformed requests are refused as the client's fault, and the next one is answered.

use crate::common::{self, Client, Fixture, NAME, plan_request, raw_query};
use planner::model::RANDOM;
use prost::Message as _;
use prost::bytes::{Buf, BufMut};
use prost::encoding::{DecodeContext, WireType};
use tonic::transport::Channel;
use tonic_prost::ProstCodec;
use wire::planner::PlanResponse;
use wire::{Code, Error, key, proto};

/// Raw bytes in place of a message.
#[derive(Debug, Default)]
struct Raw(Vec<u8>);

impl prost::Message for Raw {
    fn encode_raw(&self, buf: &mut impl BufMut) {
        buf.put_slice(&self.0);
    }

    fn merge_field(
        &mut self,
        _: u32,
        _: WireType,
        _: &mut impl Buf,
        _: DecodeContext,
    ) -> Result<(), prost::DecodeError> {
        unreachable!("only ever sent")
    }

    fn encoded_len(&self) -> usize {
        self.0.len()
    }

    fn clear(&mut self) {
        self.0.clear();
    }
}

async fn raw_grpc(channel: &Channel, method: &'static str, bytes: Vec<u8>) -> Result<proto::PlanResponse, Error> {
    let mut grpc = tonic::client::Grpc::new(channel.clone());
    grpc.ready().await.unwrap();
    let path = tonic::codegen::http::uri::PathAndQuery::from_static(method);
    let codec = ProstCodec::<Raw, proto::PlanResponse>::default();
    Ok(grpc.unary(tonic::Request::new(Raw(bytes)), path, codec).await?.into_inner())
}

const PLAN: &str = "/cpn.v1.PlannerService/Plan";
const LOAD_MODEL: &str = "/cpn.v1.PlannerService/LoadModel";
const INFER: &str = "/inference.GRPCInferenceService/ModelInfer";

fn assert_refused(error: Error, what: &str) {
    assert_eq!((error.code, error.field.as_str()), (Code::InvalidArgument, "payload"), "{what}: {error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_messages_are_refused() {
    let fixture = Fixture::start(&[], |_| ()).await;
    let valid = plan_request(RANDOM, 3).encode_to_vec();
    let truncated = valid[..valid.len() / 2].to_vec();
    let not_text = vec![0x0a, 2, 0xff, 0xfe];
    let endless = vec![0; (1 << 20) + 1];
    let key = key::planner_plan(NAME).unwrap();
    let [_, grpc @ Client::Grpc(_), zenoh @ Client::Zenoh(_)] = fixture.clients() else { unreachable!() };
    for (what, bytes) in [("truncated", truncated), ("a name that is no text", not_text), ("endless", endless)] {
        for method in [PLAN, INFER] {
            assert_refused(raw_grpc(&fixture.channel, method, bytes.clone()).await.unwrap_err(), what);
        }
        assert_refused(raw_query::<PlanResponse>(&fixture.session, &key, Some(bytes)).await.unwrap_err(), what);
        grpc.plan(plan_request(RANDOM, 3)).await.unwrap();
        zenoh.plan(plan_request(RANDOM, 3)).await.unwrap();
    }
    assert_refused(raw_query::<PlanResponse>(&fixture.session, &key, None).await.unwrap_err(), "no payload");
    zenoh.plan(plan_request(RANDOM, 3)).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn only_a_checkpoint_may_be_large() {
    let fixture = Fixture::start(&[], |_| ()).await;
    for client in fixture.clients() {
        let two_megabytes = common::from_bytes("cpn", vec![0; 2 << 20]);
        let error = client.load_model(two_megabytes).await.unwrap_err();
        assert_eq!(error.field, "checkpoint", "{}: {error}", client.transport());
    }
    let error = raw_grpc(&fixture.channel, LOAD_MODEL, vec![0; (65 << 20) + 1]).await.unwrap_err();
    assert_refused(error, "more than any checkpoint");
}

/// An error quotes the client's text, truncated to fit in a gRPC header.
#[tokio::test(flavor = "multi_thread")]
async fn a_long_name_is_refused_like_any_other() {
    let fixture = Fixture::start(&[], |_| ()).await;
    for client in fixture.clients() {
        common::is(Code::InvalidArgument, "model", client.plan(plan_request(&"x".repeat(500_000), 3)).await);
    }
}
