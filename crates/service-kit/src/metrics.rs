//! Prometheus metrics endpoint.

use crate::access::{Access, Peer, Refusal};
use crate::listener::{Connection, ListenConfig, Listener};
use anyhow::Context;
use axum::Router;
use axum::extract::connect_info::{ConnectInfo, Connected};
use axum::http::header::AUTHORIZATION;
use axum::http::{HeaderMap, StatusCode};
use axum::routing::get;
use axum::serve::IncomingStream;
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder};
use std::net::SocketAddr;
use std::time::Duration;

/// Histogram buckets of metrics in `_seconds`: upper bounds from 0.1 ms to 10 s.
const SECONDS: [f64; 16] = [1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0];
/// Histogram buckets of metrics in `_size`: upper bounds.
const SIZES: [f64; 9] = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0];

/// Interval of the recorder's upkeep, which drains the samples of histograms.
const UPKEEP: Duration = Duration::from_secs(5);
/// Maximum number of connections: a few scrapers.
pub const MAX_CONNECTIONS: usize = 16;

/// Serves this process's metrics from now on at `http://<listen>/metrics`, or `https` with TLS, to clients that pass `access`
/// and `allows`. Once per process.
///
/// # Errors
/// If the address cannot be listened on, or is beyond the loopback interface without TLS, or metrics are served already.
pub async fn serve(listen: ListenConfig, access: Access, allows: fn(identity: &str) -> bool) -> anyhow::Result<()> {
    let address = listen.address;
    let listener = Listener::bind("metrics", listen, &[b"http/1.1"]).await?;
    let recorder = PrometheusBuilder::new()
        .set_buckets_for_metric(Matcher::Suffix("_seconds".into()), &SECONDS)?
        .set_buckets_for_metric(Matcher::Suffix("_size".into()), &SIZES)?
        .install_recorder()
        .with_context(|| format!("metrics on {address}"))?;

    let upkeep = recorder.clone();
    tokio::spawn(async move {
        loop {
            tokio::time::sleep(UPKEEP).await;
            upkeep.run_upkeep();
        }
    });

    let scrape = move |ConnectInfo(Scraper(peer)): ConnectInfo<Scraper>, headers: HeaderMap| async move {
        let authorization = headers.get(AUTHORIZATION).and_then(|value| value.to_str().ok());
        match access.check(&peer, authorization, "metrics", allows) {
            Ok(()) => (StatusCode::OK, recorder.render()),
            Err(Refusal::Forbidden) => (StatusCode::FORBIDDEN, Refusal::Forbidden.to_string()),
            Err(refusal) => (StatusCode::UNAUTHORIZED, refusal.to_string()),
        }
    };

    let app = Router::new().route("/metrics", get(scrape)).into_make_service_with_connect_info::<Scraper>();
    tokio::spawn(async move { axum::serve(listener, app).await });
    Ok(())
}

/// Remote side of a scrape.
#[derive(Debug, Clone)]
struct Scraper(Peer);

impl Connected<IncomingStream<'_, Listener>> for Scraper {
    fn connect_info(stream: IncomingStream<'_, Listener>) -> Self {
        Self(stream.io().peer().clone())
    }
}

impl axum::serve::Listener for Listener {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        match self.next().await {
            Some(connection) => {
                let address = connection.peer().address;
                (connection, address)
            }
            None => std::future::pending().await,
        }
    }

    fn local_addr(&self) -> std::io::Result<SocketAddr> {
        Ok(self.address())
    }
}
