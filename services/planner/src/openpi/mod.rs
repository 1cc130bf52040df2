//! WebSocket transport of the planner, with openpi's protocol.
//!
//! The server sends its metadata to a new client. Requests are binary frames of msgpack; the answer to each is a binary frame,
//! or a text frame with an error, after which the connection stays open.

mod message;
mod numpy;

use crate::core::PlannerCore;
use futures::{SinkExt, StreamExt};
pub use message::request;
use service_kit::access::{Access, Peer, Refusal};
use service_kit::listener::{Connection, ListenConfig, Listener};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::error::{CapacityError, ProtocolError};
use tokio_tungstenite::tungstenite::handshake::machine::TryParse;
use tokio_tungstenite::tungstenite::handshake::server::{ErrorResponse, Request, create_response, write_response};
use tokio_tungstenite::tungstenite::http::header::{AUTHORIZATION, CONNECTION, CONTENT_LENGTH, CONTENT_TYPE};
use tokio_tungstenite::tungstenite::http::{HeaderValue, StatusCode};
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, Role, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Bytes, Error as SocketError, Message};
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;
use tracing::debug;
use wire::Error;
use wire::access::may_plan;

/// Maximum number of clients; further ones get HTTP 503.
const MAX_CONNECTIONS: usize = 64;
/// Maximum number of connections, including those that get HTTP 503.
pub(crate) const MAX_SOCKETS: usize = 2 * MAX_CONNECTIONS;
/// Largest request, in bytes.
const MAX_BYTES: usize = 1 << 20;
/// Longest HTTP head of the handshake, in bytes.
const MAX_HEAD_BYTES: usize = 16 << 10;
/// Path of the health check, as of openpi's server.
const HEALTH: &str = "/healthz";
/// Buffer size of a connection, per direction, in bytes; an image is 21 kB.
const BUFFER_BYTES: usize = 32 << 10;
/// Silence of a client before a ping, and timeout of its answer.
const PING_INTERVAL: Duration = Duration::from_secs(20);
/// Timeout of the handshake, and of sending a message.
const IO_TIMEOUT: Duration = Duration::from_secs(5);
/// Timeout of a client's half of the closing handshake.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

type Socket = WebSocketStream<Connection>;
/// HTTP response of the handshake; it has a body if the connection is not upgraded.
type Answer = ErrorResponse;

/// Server of openpi's protocol.
#[derive(Debug)]
pub(crate) struct OpenpiServer {
    /// Listening address.
    pub(crate) address: SocketAddr,
    /// Guard that stops the tasks when dropped.
    stop: DropGuard,
    tasks: TaskTracker,
}

impl OpenpiServer {
    /// Starts the server, for clients that pass `access`.
    ///
    /// # Errors
    /// If the address cannot be listened on, or is beyond the loopback interface without TLS.
    pub(crate) async fn start(core: PlannerCore, listen: ListenConfig, access: Access) -> anyhow::Result<Self> {
        let listener = Listener::bind("openpi", listen, &[b"http/1.1"]).await?;
        let address = listener.address();
        let (stop, tasks) = (CancellationToken::new(), TaskTracker::new());
        tasks.spawn(accept(listener, core, access, stop.clone(), tasks.clone()));
        Ok(Self { address, stop: stop.drop_guard(), tasks })
    }

    /// Stops accepting requests, answers those in flight, and closes all connections.
    pub(crate) async fn drain(self) {
        drop(self.stop);
        self.tasks.close();
        self.tasks.wait().await;
    }
}

async fn accept(
    mut listener: Listener,
    core: PlannerCore,
    access: Access,
    stop: CancellationToken,
    tasks: TaskTracker,
) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    while let Some(Some(stream)) = stop.run_until_cancelled(listener.next()).await {
        // Without a place, the client gets HTTP 503.
        let (core, stop, place) = (core.clone(), stop.clone(), Arc::clone(&places).try_acquire_owned().ok());
        let access = access.clone();
        tasks.spawn(async move {
            let client = stream.peer().address;
            if let Err(error) = serve(stream, &core, &access, place, &stop).await {
                debug!(%client, %error, "connection of an openpi client lost");
            }
        });
    }
}

/// Serves a client until it leaves or the planner stops.
async fn serve(
    stream: Connection,
    core: &PlannerCore,
    access: &Access,
    place: Option<OwnedSemaphorePermit>,
    stop: &CancellationToken,
) -> Result<(), SocketError> {
    let shaken = timeout(IO_TIMEOUT, handshake(stream, access, place.is_some())).await.map_err(timed_out)??;
    let Some(mut socket) = shaken else { return Ok(()) };
    send(&mut socket, Message::binary(message::metadata(core))).await?;

    let mut pinged = false;
    while let Some(received) = stop.run_until_cancelled(timeout(PING_INTERVAL, socket.next())).await {
        let silent = received.is_err();
        let answer = match received {
            Err(silence) if pinged => return Err(timed_out(silence)),
            Err(_) => Some(Message::Ping(Bytes::new())),
            Ok(None) => return Ok(()),
            Ok(Some(Ok(Message::Binary(payload)))) => Some(answer(core, &payload).await),
            Ok(Some(Ok(Message::Text(_)))) => {
                Some(refusal(&Error::invalid("payload", "a binary frame", "a text frame")))
            }
            Ok(Some(Ok(_))) => None,
            Ok(Some(Err(SocketError::Capacity(CapacityError::MessageTooLong { size, .. })))) => {
                send(&mut socket, refusal(&message_too_long(size))).await?;
                return close(socket, CloseCode::Size).await;
            }
            Ok(Some(Err(error))) => return Err(error),
        };
        pinged = silent;
        if let Some(answer) = answer {
            send(&mut socket, answer).await?;
        }
    }
    close(socket, CloseCode::Away).await
}

/// HTTP handshake, which upgrades the connection to a WebSocket. Health checks are answered, and other requests refused, both
/// without a socket.
async fn handshake(mut stream: Connection, access: &Access, has_place: bool) -> Result<Option<Socket>, SocketError> {
    let (request, rest) = read_request(&mut stream).await?;
    let answer = if request.uri().path() == HEALTH {
        response_of(StatusCode::OK, "OK")
    } else {
        admit(&request, access, stream.peer(), has_place).unwrap_or_else(|refusal| refusal)
    };

    let mut bytes = Vec::new();
    write_response(&mut bytes, &answer)?;
    bytes.extend(answer.body().iter().flat_map(|text| text.bytes()));
    stream.write_all(&bytes).await?;
    if answer.status() != StatusCode::SWITCHING_PROTOCOLS {
        stream.shutdown().await?;
        return Ok(None);
    }

    let config = WebSocketConfig::default()
        .read_buffer_size(BUFFER_BYTES)
        .write_buffer_size(BUFFER_BYTES)
        .max_message_size(Some(MAX_BYTES))
        .max_frame_size(Some(MAX_BYTES));
    Ok(Some(WebSocketStream::from_partially_read(stream, rest, Role::Server, Some(config)).await))
}

/// Reads the head of a GET request; returns it with the bytes after it.
async fn read_request(stream: &mut Connection) -> Result<(Request, Vec<u8>), SocketError> {
    let mut head = Vec::new();
    loop {
        if let Some((size, request)) = Request::try_parse(&head)? {
            return Ok((request, head.split_off(size)));
        }
        if head.len() > MAX_HEAD_BYTES || stream.read_buf(&mut head).await? == 0 {
            return Err(SocketError::Protocol(ProtocolError::HandshakeIncomplete));
        }
    }
}

/// HTTP response to a WebSocket request.
#[expect(clippy::result_large_err, reason = "both are answers")]
fn admit(request: &Request, access: &Access, peer: &Peer, has_place: bool) -> Result<Answer, Answer> {
    let response =
        create_response(request).map_err(|error| response_of(StatusCode::BAD_REQUEST, &error.to_string()))?;
    let authorization = request.headers().get(AUTHORIZATION).and_then(|value| value.to_str().ok());
    if let Err(refusal) = access.check(peer, authorization, "openpi", may_plan) {
        let forbidden = refusal == Refusal::Forbidden;
        let status = if forbidden { StatusCode::FORBIDDEN } else { StatusCode::UNAUTHORIZED };
        return Err(response_of(status, &refusal.to_string()));
    }
    if !has_place {
        let reason = format!("connections: expected a free place, got {MAX_CONNECTIONS}");
        return Err(response_of(StatusCode::SERVICE_UNAVAILABLE, &reason));
    }
    Ok(response.map(|()| None))
}

fn response_of(status: StatusCode, text: &str) -> Answer {
    let text = format!("{text}\n");
    let mut response = Answer::new(None);
    *response.status_mut() = status;
    response.headers_mut().insert(CONTENT_LENGTH, text.len().into());
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("text/plain; charset=utf-8"));
    response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
    *response.body_mut() = Some(text);
    response
}

async fn answer(core: &PlannerCore, payload: &[u8]) -> Message {
    let plan = async { core.plan(message::request(payload, || core.list_models())?).await.map_err(message::renamed) };
    plan.await.map_or_else(|error| refusal(&error), |plan| Message::binary(message::answer(plan)))
}

fn refusal(error: &Error) -> Message {
    Message::text(error.to_string())
}

fn message_too_long(bytes: usize) -> Error {
    Error::invalid("payload", format!("at most {MAX_BYTES} bytes"), format!("{bytes} bytes"))
}

async fn send(socket: &mut Socket, message: Message) -> Result<(), SocketError> {
    timeout(IO_TIMEOUT, socket.send(message)).await.map_err(timed_out)?
}

/// Closes a connection. Data still arriving is read and discarded: on a reset, the client would not read the close frame.
async fn close(mut socket: Socket, code: CloseCode) -> Result<(), SocketError> {
    send(&mut socket, Message::Close(Some(CloseFrame { code, reason: "".into() }))).await?;
    let stream = socket.get_mut();
    stream.shutdown().await?;
    let mut rest = stream.take(16 * MAX_BYTES as u64);
    timeout(CLOSE_TIMEOUT, tokio::io::copy(&mut rest, &mut tokio::io::sink())).await.map_err(timed_out)??;
    Ok(())
}

fn timed_out(silence: tokio::time::error::Elapsed) -> SocketError {
    SocketError::Io(silence.into())
}
