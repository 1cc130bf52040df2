//! `cpn-health`: gRPC health check by exit code, for orchestrators.

use anyhow::{Context, ensure};
use clap::Parser;
use hyper_util::rt::TokioIo;
use service_kit::SessionConfig;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::ServerName;
use tokio_util::either::Either;
use tonic::transport::{Endpoint, Uri};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tower::service_fn;

/// Health check of a planner or trainer: exit code 0 if it serves, 1 otherwise.
#[derive(Debug, Parser)]
#[command(version)]
struct Args {
    /// Address of gRPC, for example 127.0.0.1:50051.
    address: String,
    /// Part of the service: all of it if empty, `zenoh` for the connection to the network.
    #[arg(long, default_value = "")]
    service: String,
    /// Host in the server's certificate [default: that of the address].
    #[arg(long)]
    server_name: Option<String>,
    /// Timeout of the answer, in seconds.
    #[arg(long, default_value_t = 5)]
    timeout_secs: u64,
    #[command(flatten)]
    session: SessionConfig,
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> anyhow::Result<()> {
    let args: Args = service_kit::config::parse();
    let timeout = Duration::from_secs(args.timeout_secs);
    let status = tokio::time::timeout(timeout, ask(args)).await.context("no answer in time")??;
    ensure!(status == ServingStatus::Serving, "expected SERVING, got {}", status.as_str_name());
    Ok(())
}

async fn ask(args: Args) -> anyhow::Result<ServingStatus> {
    let Args { address, service, server_name, session, .. } = args;
    let host = address.rsplit_once(':').map_or(address.as_str(), |(host, _)| host);
    let name = ServerName::try_from(server_name.unwrap_or_else(|| host.to_owned()))?;

    let tls = match session.tls()? {
        Some(tls) => {
            let mut config = tls.client()?;
            config.alpn_protocols = vec![b"h2".to_vec()];
            Some(TlsConnector::from(Arc::new(config)))
        }
        None => None,
    };

    let endpoint = Endpoint::from_shared(format!("http://{address}"))?;
    let connect = service_fn(move |_: Uri| {
        let (address, name, tls) = (address.clone(), name.clone(), tls.clone());
        async move {
            let stream = TcpStream::connect(&address).await?;
            let stream = match tls {
                Some(tls) => Either::Right(tls.connect(name, stream).await?),
                None => Either::Left(stream),
            };
            std::io::Result::Ok(TokioIo::new(stream))
        }
    });

    let channel = endpoint.connect_with_connector(connect).await?;
    let answer = HealthClient::new(channel).check(HealthCheckRequest { service }).await?;
    Ok(answer.into_inner().status())
}
