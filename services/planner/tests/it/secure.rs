//! Listeners with TLS: clients are authorised by role; refusals are clear, logged and counted.

use crate::common::{self, Fixture, soon};
use certs::Authority;
use futures::StreamExt;
use planner::{Config, Planner};
use service_kit::SessionConfig;
use service_kit::tls::Tls;
use std::collections::BTreeSet;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;
use std::sync::Arc;
use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_tungstenite::client_async;
use tokio_tungstenite::tungstenite::Error as SocketError;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tonic::metadata::MetadataValue;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Identity};
use tonic::{Code, Request};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;
use wire::inference::grpc_inference_service_client::GrpcInferenceServiceClient;
use wire::inference::{ModelInferRequest, ServerLiveRequest};
use wire::proto;
use wire::proto::planner_service_client::PlannerServiceClient;

const METRICS: &str = "127.0.0.1:17499";
const LOOPBACK: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);
const ANYWHERE: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::UNSPECIFIED), 0);

/// Planner that listens with TLS, and its network's authority.
struct Secure {
    files: TempDir,
    _models: TempDir,
    planner: Planner,
}

impl Secure {
    async fn start() -> Self {
        let (files, models) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let none = BTreeSet::new();
        let mut authority = Authority::open(files.path(), 1).unwrap();
        authority.init(&none, none.clone()).unwrap();
        authority.issue("operator.gone", &none).unwrap();
        authority.revoke("operator.gone").unwrap();
        authority.issue_token("client.stolen").unwrap();
        authority.revoke_tokens("client.stolen").unwrap();
        let token = authority.issue_token("client").unwrap();
        std::fs::write(files.path().join("token"), token).unwrap();
        drop(authority);
        let own = files.path().join("planner");
        let planner = planner::start(Config {
            models_dir: models.path().into(),
            grpc_listen: LOOPBACK,
            openpi_listen: Some(LOOPBACK),
            metrics_listen: Some(METRICS.parse().unwrap()),
            tokens: Some(own.join("tokens.json")),
            session: SessionConfig {
                tls_ca: Some(own.join("ca.pem")),
                tls_certificate: Some(own.join("certificate.pem")),
                tls_private_key: Some(own.join("private-key.pem")),
                tls_crl: Some(own.join("crl.pem")),
                ..SessionConfig::default()
            },
            ..Config::default()
        });
        Self { planner: planner.await.unwrap(), files, _models: models }
    }

    fn tls(&self, identity: &str) -> Tls {
        let files = self.files.path().join(identity);
        let file = |name: &str| files.join(name);
        Tls {
            ca: file("ca.pem"),
            certificate: file("certificate.pem"),
            private_key: file("private-key.pem"),
            crl: None,
        }
    }

    /// Channel with a client certificate, or without.
    async fn channel(&self, identity: Option<&str>) -> Result<Channel, tonic::transport::Error> {
        let read = |path: &Path| std::fs::read(path).unwrap();
        let mut tls = ClientTlsConfig::new()
            .ca_certificate(Certificate::from_pem(read(&self.tls("client").ca)))
            .domain_name("localhost");
        if let Some(identity) = identity {
            let files = self.tls(identity);
            tls = tls.identity(Identity::from_pem(read(&files.certificate), read(&files.private_key)));
        }
        let url = format!("https://{}", self.planner.grpc_address());
        Channel::from_shared(url).unwrap().tls_config(tls).unwrap().connect().await
    }

    /// Status codes of a request that clients may make, and of one that only operators may.
    async fn codes(&self, identity: Option<&str>, token: Option<&str>) -> [Code; 2] {
        let mut planner = PlannerServiceClient::new(self.channel(identity).await.unwrap());
        let load = proto::LoadModelRequest {
            model: "m".into(),
            source: Some(proto::load_model_request::Source::File("m.safetensors".into())),
        };
        let authorized = |request: proto::LoadModelRequest| authorize(Request::new(request), token);
        let list = authorize(Request::new(proto::ListModelsRequest {}), token);
        let listed = planner.list_models(list).await.map_or_else(|status| status.code(), |_| Code::Ok);
        let loaded = planner.load_model(authorized(load)).await.map_or_else(|status| status.code(), |_| Code::Ok);
        [listed, loaded]
    }

    /// Status codes of `ServerLive` and `ModelInfer`, an empty request.
    async fn inference_codes(&self, identity: Option<&str>) -> [Code; 2] {
        let mut planner = GrpcInferenceServiceClient::new(self.channel(identity).await.unwrap());
        let live = planner.server_live(ServerLiveRequest {}).await.map_or_else(|status| status.code(), |_| Code::Ok);
        let inferred = planner.model_infer(ModelInferRequest::default()).await;
        [live, inferred.map_or_else(|status| status.code(), |_| Code::Ok)]
    }

    async fn stream(&self, address: SocketAddr, identity: &str) -> TlsStream<TcpStream> {
        let connector = TlsConnector::from(Arc::new(self.tls(identity).client().unwrap()));
        let stream = TcpStream::connect(address).await.unwrap();
        connector.connect("localhost".try_into().unwrap(), stream).await.unwrap()
    }

    async fn scrape(&self, identity: &str) -> String {
        let mut stream = self.stream(METRICS.parse().unwrap(), identity).await;
        stream.write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").await.unwrap();
        let mut answer = String::new();
        // The server may end the stream without TLS's close notification.
        let _ = stream.read_to_string(&mut answer).await;
        answer
    }
}

fn authorize<T>(mut request: Request<T>, token: Option<&str>) -> Request<T> {
    if let Some(token) = token {
        let value = MetadataValue::try_from(format!("Bearer {token}")).unwrap();
        request.metadata_mut().insert("authorization", value);
    }
    request
}

#[tokio::test(flavor = "multi_thread")]
async fn clients_are_authorised_by_role() {
    let secure = Secure::start().await;
    let token = std::fs::read_to_string(secure.files.path().join("token")).unwrap();
    let missing = [Code::Unauthenticated; 2];
    // The file that the operator names does not exist.
    assert_eq!(secure.codes(Some("operator"), None).await, [Code::Ok, Code::NotFound]);
    assert_eq!(secure.codes(Some("client"), None).await, [Code::Ok, Code::PermissionDenied]);
    assert_eq!(secure.codes(Some("worker"), None).await, [Code::PermissionDenied; 2]);
    assert_eq!(secure.codes(None, Some(&token)).await, [Code::Ok, Code::PermissionDenied]);
    assert_eq!(secure.codes(None, Some("guessed")).await, missing);
    assert_eq!(secure.codes(None, None).await, missing);
    assert_eq!(secure.inference_codes(Some("client")).await, [Code::Ok, Code::InvalidArgument]);
    assert_eq!(secure.inference_codes(Some("viewer")).await, [Code::Ok, Code::PermissionDenied]);
    assert_eq!(secure.inference_codes(Some("worker")).await, [Code::PermissionDenied; 2]);
    assert_eq!(secure.inference_codes(None).await, missing);
    // Orchestrators check health without credentials.
    let mut health = HealthClient::new(secure.channel(None).await.unwrap());
    health.check(HealthCheckRequest { service: "zenoh".into() }).await.unwrap();

    // Neither a revoked certificate nor plain text gets a connection.
    let gone = secure.channel(Some("operator.gone")).await;
    let asked = match gone {
        Ok(channel) => PlannerServiceClient::new(channel).list_models(proto::ListModelsRequest {}).await.map(drop),
        Err(_) => Err(tonic::Status::unavailable("no connection")),
    };
    assert!(asked.is_err());
    let plain = Channel::from_shared(format!("http://{}", secure.planner.grpc_address())).unwrap().connect().await;
    let asked = match plain {
        Ok(channel) => PlannerServiceClient::new(channel).list_models(proto::ListModelsRequest {}).await.map(drop),
        Err(_) => Err(tonic::Status::unavailable("no connection")),
    };
    assert!(asked.is_err());

    // openpi's client sends its token as an API key.
    let address = secure.planner.openpi_address().unwrap();
    for (key, expected) in [(Some(token.as_str()), 101), (Some("guessed"), 401), (None, 403)] {
        let mut request = format!("wss://localhost:{}", address.port()).into_client_request().unwrap();
        if let Some(key) = key {
            request.headers_mut().insert("Authorization", format!("Api-Key {key}").parse().unwrap());
        }
        // A worker may not plan.
        let status = match client_async(request, secure.stream(address, "worker").await).await {
            Ok((mut socket, response)) => {
                soon(socket.next()).await.unwrap().unwrap();
                response.status()
            }
            Err(SocketError::Http(response)) => response.status(),
            Err(error) => panic!("{error}"),
        };
        assert_eq!(status.as_u16(), expected, "{key:?}");
    }

    let refused = secure.scrape("client").await;
    assert!(refused.starts_with("HTTP/1.1 403"), "{refused}");
    let metrics = secure.scrape("viewer").await;
    for line in [
        "cpn_access_refused_total{reason=\"missing\"} 4",
        "cpn_access_refused_total{reason=\"unknown\"} 3",
        "cpn_access_refused_total{reason=\"forbidden\"} 9",
        "cpn_zenoh_connected 1",
    ] {
        assert!(metrics.lines().any(|found| found == line), "{line}: not in\n{metrics}");
    }
    for name in [
        "cpn_connections_refused_total{listener=\"gRPC\",reason=\"handshake\"}",
        "cpn_certificate_expiry_timestamp_seconds",
    ] {
        assert!(metrics.lines().any(|found| found.starts_with(name)), "{name}: not in\n{metrics}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_listens_beyond_the_loopback_interface_in_plain_text() {
    let models = tempfile::tempdir().unwrap();
    let base = || Config { models_dir: models.path().into(), grpc_listen: LOOPBACK, ..Config::default() };
    let zenoh = |insecure| SessionConfig { listen: vec!["tcp/0.0.0.0:0".into()], insecure, ..SessionConfig::default() };
    let cases = [
        ("gRPC on 0.0.0.0:0", Config { grpc_listen: ANYWHERE, ..base() }),
        ("openpi on 0.0.0.0:0", Config { openpi_listen: Some(ANYWHERE), ..base() }),
        ("metrics on 0.0.0.0:0", Config { metrics_listen: Some(ANYWHERE), ..base() }),
        ("listen", Config { session: zenoh(false), ..base() }),
    ];
    for (field, config) in cases {
        let error = format!("{:#}", planner::start(config).await.unwrap_err());
        assert!(error.starts_with(&format!("{field}: expected")), "{error}");
        assert!(error.contains("beyond the loopback interface, or insecure to be set, got"), "{error}");
    }
    let open = Config { session: zenoh(true), grpc_listen: ANYWHERE, openpi_listen: Some(ANYWHERE), ..base() };
    planner::start(open).await.unwrap().shutdown().await.unwrap();

    let half = SessionConfig { tls_ca: Some("ca.pem".into()), ..SessionConfig::default() };
    let error = planner::start(Config { session: half, ..base() }).await.unwrap_err().to_string();
    assert_eq!(error, "tls_certificate, tls_private_key: expected a file, as other TLS files are given, got none");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_name_that_is_taken_is_refused() {
    let fixture = Fixture::start(&[], |_| ()).await;
    let connect = fixture.session.info().locators().await.iter().map(ToString::to_string).collect();
    let key = wire::key::planner_alive("*").unwrap();
    let tokens = fixture.session.liveliness().get(key).await.unwrap();
    let token = tokens.recv_async().await.unwrap().into_result().unwrap();
    assert!(token.key_expr().ends_with(common::NAME));
    let twin = Config {
        name: common::NAME.into(),
        models_dir: fixture.models_dir.path().into(),
        grpc_listen: LOOPBACK,
        session: SessionConfig { namespace: fixture.namespace.clone(), connect, ..SessionConfig::default() },
        ..Config::default()
    };
    let error = planner::start(twin).await.unwrap_err().to_string();
    assert!(error.starts_with("name: expected one that no running service has, got that of"), "{error}");
}
