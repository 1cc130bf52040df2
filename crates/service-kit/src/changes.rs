//! Log and metric of refused state changes.

use crate::access::Peer;
use axum::Router;
use axum::extract::Request;
use axum::middleware::{self, Next};
use axum::response::Response;
use metrics::counter;
use std::fmt::Display;
use tonic::Status;
use tracing::warn;

/// State-changing requests of a service.
#[derive(Debug, Clone, Copy)]
pub struct Changes {
    /// Metric that counts refusals, by `change`.
    pub metric: &'static str,
    /// Paths of the state-changing gRPC methods, and their names in log and metric.
    pub methods: &'static [(&'static str, &'static str)],
}

impl Changes {
    /// Counts and logs a refused change, with its origin, an address or a zenoh key, and the reason.
    pub fn refused(&self, change: &'static str, by: impl Display, why: impl Display) {
        counter!(self.metric, "change" => change).increment(1);
        warn!(change, %by, %why, "a change was refused");
    }

    /// Counts and logs every refusal by the gRPC methods, with the peer's address and the name in its certificate.
    pub fn watch(&'static self, routes: Router) -> Router {
        routes.layer(middleware::from_fn(move |request, next| self.handle(request, next)))
    }

    async fn handle(&self, request: Request, next: Next) -> Response {
        let path = request.uri().path();
        let Some((_, change)) = self.methods.iter().find(|(method, _)| *method == path) else {
            return next.run(request).await;
        };
        let by = request.extensions().get::<Peer>().map_or_else(
            || "unknown".to_owned(),
            |Peer { address, certificate }| match certificate {
                Some(name) => format!("{address}, {name}"),
                None => address.to_string(),
            },
        );

        let response = next.run(request).await;
        // Tonic sends a refusal entirely in the headers.
        let status = Status::from_header_map(response.headers());
        if let Some(status) = status.filter(|status| status.code() != tonic::Code::Ok) {
            self.refused(change, by, status.message());
        }
        response
    }
}
