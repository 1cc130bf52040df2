//! Logs and traces.

use anyhow::Context;
use opentelemetry::global;
use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::SpanExporter;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::SdkTracerProvider;
use std::env;
use std::io::{IsTerminal, stderr};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

/// OpenTelemetry's environment variable with the endpoint for spans; tracing is off without it.
const ENDPOINT: &str = "OTEL_EXPORTER_OTLP_ENDPOINT";
/// Targets whose spans are exported.
const TRACED: [&str; 4] = ["evaluator", "planner", "service_kit", "wire"];

/// Guard of the span exporter; sends pending spans when dropped.
#[derive(Debug)]
pub struct Telemetry(Option<SdkTracerProvider>);

/// Starts logging to standard error, at level `info` or as `RUST_LOG` sets it, and, if `OTEL_EXPORTER_OTLP_ENDPOINT` is set,
/// the export of spans over gRPC under the service name `service`.
///
/// # Errors
/// If the endpoint is malformed.
pub fn init(service: &'static str) -> anyhow::Result<Telemetry> {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info,zenoh=error"));
    let logs = tracing_subscriber::fmt::layer().with_writer(stderr).with_ansi(stderr().is_terminal());

    let provider =
        env::var_os(ENDPOINT).filter(|endpoint| !endpoint.is_empty()).map(|_| provider(service)).transpose()?;
    let traces = provider.as_ref().map(|provider| {
        global::set_text_map_propagator(TraceContextPropagator::new());
        let targets = TRACED.map(|target| (target, tracing_subscriber::filter::LevelFilter::DEBUG));
        tracing_opentelemetry::layer().with_tracer(provider.tracer(service)).with_filter(Targets::from_iter(targets))
    });

    tracing_subscriber::registry().with(logs.with_filter(filter)).with(traces).init();
    Ok(Telemetry(provider))
}

fn provider(service: &'static str) -> anyhow::Result<SdkTracerProvider> {
    let exporter = SpanExporter::builder().with_tonic().build().context(ENDPOINT)?;
    let resource = Resource::builder().with_service_name(service).build();
    Ok(SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource).build())
}

impl Drop for Telemetry {
    fn drop(&mut self) {
        if let Some(Err(error)) = self.0.take().map(|provider| provider.shutdown()) {
            tracing::warn!(%error, "spans not sent");
        }
    }
}
