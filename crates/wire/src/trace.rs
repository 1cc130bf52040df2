//! Trace context propagation: a request carries the W3C `traceparent` of the span that sent it, over zenoh as the attachment
//! and over gRPC as a header.

use opentelemetry::global;
use std::collections::HashMap;
use tracing::Span;
use tracing_opentelemetry::OpenTelemetrySpanExt;

/// Name of the header, and of the propagator's only field.
pub const TRACEPARENT: &str = "traceparent";

/// W3C `traceparent` of the current span; none if tracing is off.
pub fn traceparent() -> Option<String> {
    let mut fields = HashMap::new();
    global::get_text_map_propagator(|propagator| propagator.inject_context(&Span::current().context(), &mut fields));
    fields.remove(TRACEPARENT)
}

/// Makes a span the child of a request's span. Without a valid `traceparent` the span starts a trace of its own.
pub fn follow(span: &Span, traceparent: Option<&str>) {
    if let Some(traceparent) = traceparent {
        let fields = HashMap::from([(TRACEPARENT.to_owned(), traceparent.to_owned())]);
        let context = global::get_text_map_propagator(|propagator| propagator.extract(&fields));
        // A span that is not recorded has no parent to set.
        let _ = span.set_parent(context);
    }
}
