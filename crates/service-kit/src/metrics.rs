//! Metrics for Prometheus.

use anyhow::Context;
use metrics_exporter_prometheus::PrometheusBuilder;
use std::net::SocketAddr;

/// Answers scrapes at `http://<listen>/metrics` with everything this process counts from now on; once a process.
///
/// # Errors
/// If the address cannot be listened on, or metrics are served already.
pub fn serve(listen: SocketAddr) -> anyhow::Result<()> {
    PrometheusBuilder::new().with_http_listener(listen).install().with_context(|| format!("metrics on {listen}"))
}
