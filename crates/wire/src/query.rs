//! Typed request and reply over zenoh queries.

use crate::{Code, Error, Message, decode, encode, proto, trace};
use prost::{Message as _, Name};
use std::time::Duration;
use tracing::{Instrument, debug_span};
use zenoh::bytes::Encoding;
use zenoh::key_expr::{OwnedKeyExpr, keyexpr};
use zenoh::query::{ConsolidationMode, Query, Reply};
use zenoh::{Session, Wait};

/// Zenoh encoding of a payload that is the protobuf message `N`.
pub fn encoding<N: Name>() -> Encoding {
    Encoding::APPLICATION_PROTOBUF.with_schema(N::full_name())
}

/// Sends a request and awaits its single answer.
///
/// # Errors
/// The service's own error; [`Code::Unavailable`] if no service answers at the key, or, about the field `session`, if no
/// router or peer is connected; [`Code::DeadlineExceeded`] if no answer came in time.
pub async fn call<Q: Message, R: Message>(
    session: &Session,
    key: &OwnedKeyExpr,
    request: Q,
    timeout: Duration,
) -> Result<R, Error> {
    let unavailable = |e: zenoh::Error| Error::new(Code::Unavailable, key.as_str(), "an answer", e);
    let ask = async {
        let replies = session
            .get(key)
            .payload(encode(request))
            .encoding(encoding::<Q::Proto>())
            .attachment(trace::traceparent())
            .consolidation(ConsolidationMode::None)
            .timeout(timeout)
            .await
            .map_err(unavailable)?;
        // Right after a reconnect a query can end at once without any reply.
        let Ok(reply) = replies.recv_async().await else {
            return Err(no_reply(session, key).await);
        };
        decode_reply(reply, key, timeout)
    };
    ask.instrument(debug_span!("query", otel.kind = "client", %key)).await
}

/// Error of a query without a reply: no connection, no service at the key, or none that this role may query.
async fn no_reply(session: &Session, key: &OwnedKeyExpr) -> Error {
    let info = session.info();
    let connected = info.routers_zid().await.next().is_some() || info.peers_zid().await.next().is_some();
    if connected {
        Error::new(Code::Unavailable, key.as_str(), "a service that may be asked", "none connected")
    } else {
        Error::new(Code::Unavailable, "session", "a router or peer", "none connected")
    }
}

/// Queries a key without a payload and collects all answers, in order of arrival; several services may give the same one.
/// No answer is no error.
///
/// # Errors
/// The first error among the answers; [`Code::DeadlineExceeded`] if the answers did not end in time;
/// [`Code::ResourceExhausted`] if there are more than `limit`.
pub async fn collect<R: Message>(
    session: &Session,
    key: &OwnedKeyExpr,
    limit: usize,
    timeout: Duration,
) -> Result<Vec<R>, Error> {
    let unavailable = |e: zenoh::Error| Error::new(Code::Unavailable, key.as_str(), "answers", e);
    let replies =
        session.get(key).consolidation(ConsolidationMode::None).timeout(timeout).await.map_err(unavailable)?;
    let mut answers = Vec::new();
    while let Ok(reply) = replies.recv_async().await {
        if answers.len() == limit {
            let expected = format!("at most {limit} answers");
            return Err(Error::new(Code::ResourceExhausted, key.as_str(), expected, "more"));
        }
        answers.push(decode_reply(reply, key, timeout)?);
    }
    Ok(answers)
}

fn decode_reply<R: Message>(reply: Reply, key: &OwnedKeyExpr, timeout: Duration) -> Result<R, Error> {
    match reply.into_result() {
        Ok(sample) => decode(&sample.payload().to_bytes()),
        Err(error) if *error.encoding() == encoding::<proto::Error>() => {
            Err(proto::Error::decode(&*error.payload().to_bytes())
                .map_or_else(|e| Error::new(Code::Internal, "error", "cpn.v1.Error", e), Error::from))
        }
        // Zenoh's own error replies are plain text; the one it sends is "Timeout".
        Err(_) => Err(Error::new(
            Code::DeadlineExceeded,
            key.as_str(),
            format!("an answer within {} ms", timeout.as_millis()),
            "none",
        )),
    }
}

/// Decodes the request in a query.
///
/// # Errors
/// If its payload is missing or invalid.
pub fn request<Q: Message>(query: &Query) -> Result<Q, Error> {
    let payload = query.payload().ok_or_else(|| Error::missing("payload"))?;
    decode(&payload.to_bytes())
}

/// W3C `traceparent` of the span that sent a query, if it carries one.
pub fn traceparent(query: &Query) -> Option<String> {
    query.attachment().and_then(|attachment| attachment.try_to_string().ok().map(Into::into))
}

/// Answers a query, with the value or the error.
///
/// # Errors
/// If zenoh cannot send it.
pub fn reply<R: Message>(query: &Query, result: Result<R, Error>) -> zenoh::Result<()> {
    reply_as(query, query.key_expr(), result)
}

/// Answers a query to many services as the service at `key`: zenoh takes answers under one key for versions of one value, and
/// delivers only the last.
///
/// # Errors
/// If zenoh cannot send it.
pub fn reply_as<R: Message>(query: &Query, key: &keyexpr, result: Result<R, Error>) -> zenoh::Result<()> {
    match result {
        Ok(response) => reply_at(query, key, response),
        Err(error) => refuse(query, error),
    }
}

/// Answers a query with an error.
///
/// # Errors
/// If zenoh cannot send it.
pub fn refuse(query: &Query, error: Error) -> zenoh::Result<()> {
    query.reply_err(proto::Error::from(error).encode_to_vec()).encoding(encoding::<proto::Error>()).wait()
}

/// Adds one of several answers to a query: the value at `key`, which the query's key expression must match.
///
/// # Errors
/// If zenoh cannot send it.
pub fn reply_at<R: Message>(query: &Query, key: &keyexpr, response: R) -> zenoh::Result<()> {
    query.reply(key, encode(response)).encoding(encoding::<R::Proto>()).wait()
}
