//! Conversions shared by all gRPC services.

use crate::{Error, Message};
use std::future::Future;
use tonic::codegen::http;
use tonic::{Request, Response, Status};

/// Validates a request, serves it, and encodes the answer.
///
/// # Errors
/// If the request is invalid, or the service refuses it.
pub async fn answer<Q: Message, R: Message, F>(
    request: Request<Q::Proto>,
    serve: impl FnOnce(Q) -> F,
) -> Result<Response<R::Proto>, Status>
where
    F: Future<Output = Result<R, Error>>,
{
    let request = Q::try_from(request.into_inner())?;
    Ok(Response::new(serve(request).await?.into()))
}

/// Replaces tonic's own refusals of a message, which carry no details, by the error of the other transports: a message
/// that is too long or is not protobuf is `INVALID_ARGUMENT`, not `INTERNAL`.
pub fn name_unreadable_payload<B>(mut response: http::Response<B>) -> http::Response<B> {
    let Some(status) = Status::from_header_map(response.headers()).filter(|status| status.details().is_empty()) else {
        return response;
    };
    let expected = match status.code() {
        tonic::Code::OutOfRange => "a shorter message",
        tonic::Code::Internal => "a protobuf message",
        _ => return response,
    };
    // A refusal that does not fit in a header stays as tonic wrote it.
    let _ = Status::from(Error::invalid("payload", expected, status.message())).add_header(response.headers_mut());
    response
}
