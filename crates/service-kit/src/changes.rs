//! Refused changes of state: each leaves a line in the log and is counted.

use crate::access::Peer;
use axum::Router;
use axum::extract::Request;
use axum::middleware::{self, Next};
use axum::response::Response;
use metrics::counter;
use std::fmt::Display;
use tonic::Status;
use tracing::warn;

/// What can be changed of a service.
#[derive(Debug, Clone, Copy)]
pub struct Changes {
    /// Metric that counts refusals, by `change`.
    pub metric: &'static str,
    /// Paths of the gRPC methods that change something, and the names of the changes.
    pub methods: &'static [(&'static str, &'static str)],
}

impl Changes {
    /// Counts and logs a change that was refused: who asked for it, as an address or a zenoh key, and why not.
    pub fn refused(&self, change: &'static str, by: impl Display, why: impl Display) {
        counter!(self.metric, "change" => change).increment(1);
        warn!(change, %by, %why, "a change was refused");
    }

    /// Does so for every refusal of the methods, with the peer's address and certificate, if it has shown one.
    pub fn watch(&'static self, routes: Router) -> Router {
        routes.layer(middleware::from_fn(move |request, next| self.pass(request, next)))
    }

    async fn pass(&self, request: Request, next: Next) -> Response {
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
        // A refusal comes whole in the headers.
        let status = Status::from_header_map(response.headers());
        if let Some(status) = status.filter(|status| status.code() != tonic::Code::Ok) {
            self.refused(change, by, status.message());
        }
        response
    }
}
