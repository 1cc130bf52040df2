//! The planner for clients of openpi: its WebSocket protocol.
//!
//! A client that connects is sent the metadata. It sends requests as binary frames of msgpack and gets an answer to each:
//! a binary frame, or a text frame with an error, after which it can go on.

mod message;
mod numpy;

use crate::core::PlannerCore;
use anyhow::Context;
use futures::{SinkExt, StreamExt};
pub use message::request;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{sleep, timeout};
use tokio_tungstenite::tungstenite::error::CapacityError;
use tokio_tungstenite::tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tokio_tungstenite::tungstenite::http::StatusCode;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Bytes, Error as SocketError, Message};
use tokio_tungstenite::{WebSocketStream, accept_hdr_async_with_config};
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;
use tracing::{debug, warn};
use wire::Error;

/// Most clients at the same time; one more is refused.
const MAX_CONNECTIONS: usize = 64;
/// Largest request.
const MAX_BYTES: usize = 1 << 20;
/// What a connection buffers, one way; a picture is 21 kB.
const BUFFER_BYTES: usize = 32 << 10;
/// How long a client may say nothing before it is asked for a sign of life, and then again before it is given up.
const SILENCE: Duration = Duration::from_secs(20);
/// How long a client may take to shake hands, or to take an answer.
const PATIENCE: Duration = Duration::from_secs(5);
/// How long a client may take to read why it is hung up on.
const LINGER: Duration = Duration::from_secs(1);

type Socket = WebSocketStream<TcpStream>;

/// The planner's place among servers of openpi.
#[derive(Debug)]
pub(crate) struct OpenpiServer {
    /// Where it listens.
    pub(crate) address: SocketAddr,
    /// Stops the tasks when it goes.
    stop: DropGuard,
    tasks: TaskTracker,
}

impl OpenpiServer {
    /// Listens and answers.
    ///
    /// # Errors
    /// If the address cannot be listened on.
    pub(crate) async fn start(core: PlannerCore, listen: SocketAddr) -> anyhow::Result<Self> {
        let listener = TcpListener::bind(listen).await.with_context(|| format!("openpi on {listen}"))?;
        let address = listener.local_addr()?;
        let (stop, tasks) = (CancellationToken::new(), TaskTracker::new());
        tasks.spawn(accept(listener, core, stop.clone(), tasks.clone()));
        Ok(Self { address, stop: stop.drop_guard(), tasks })
    }

    /// Takes no more requests, answers those in flight, and closes every connection.
    pub(crate) async fn drain(self) {
        drop(self.stop);
        self.tasks.close();
        self.tasks.wait().await;
    }
}

async fn accept(listener: TcpListener, core: PlannerCore, stop: CancellationToken, tasks: TaskTracker) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    while let Some(accepted) = stop.run_until_cancelled(listener.accept()).await {
        match accepted {
            // Who comes when all places are taken is told so; of those, too, there may only be so many.
            Ok((stream, client)) if tasks.len() <= 2 * MAX_CONNECTIONS => {
                let (core, stop, place) = (core.clone(), stop.clone(), Arc::clone(&places).try_acquire_owned().ok());
                tasks.spawn(async move {
                    if let Err(error) = serve(stream, &core, place, &stop).await {
                        debug!(%client, %error, "connection of an openpi client lost");
                    }
                });
            }
            Ok(_) => (),
            Err(error) => {
                warn!(%error, "no connection to an openpi client");
                sleep(Duration::from_secs(1)).await;
            }
        }
    }
}

/// Serves a client until it leaves or the planner stops.
async fn serve(
    stream: TcpStream,
    core: &PlannerCore,
    place: Option<OwnedSemaphorePermit>,
    stop: &CancellationToken,
) -> Result<(), SocketError> {
    let mut socket = timeout(PATIENCE, shake_hands(stream, place.is_some())).await.map_err(too_slow)??;
    send(&mut socket, Message::binary(message::metadata(core))).await?;
    let mut asked = false;
    while let Some(received) = stop.run_until_cancelled(timeout(SILENCE, socket.next())).await {
        let silent = received.is_err();
        let answer = match received {
            Err(silence) if asked => return Err(too_slow(silence)),
            Err(_) => Some(Message::Ping(Bytes::new())),
            Ok(None) => return Ok(()),
            Ok(Some(Ok(Message::Binary(payload)))) => Some(answer(core, &payload).await),
            Ok(Some(Ok(Message::Text(_)))) => {
                Some(refusal(&Error::invalid("payload", "a binary frame", "a text frame")))
            }
            Ok(Some(Ok(_))) => None,
            Ok(Some(Err(SocketError::Capacity(CapacityError::MessageTooLong { size, .. })))) => {
                send(&mut socket, refusal(&too_long(size))).await?;
                return hang_up(socket, CloseCode::Size).await;
            }
            Ok(Some(Err(error))) => return Err(error),
        };
        asked = silent;
        if let Some(answer) = answer {
            send(&mut socket, answer).await?;
        }
    }
    hang_up(socket, CloseCode::Away).await
}

#[expect(clippy::result_large_err, reason = "the library's signature")]
async fn shake_hands(stream: TcpStream, has_place: bool) -> Result<Socket, SocketError> {
    stream.set_nodelay(true)?;
    let admit = |_: &Request, response: Response| {
        if has_place {
            return Ok(response);
        }
        let mut refused =
            ErrorResponse::new(Some(format!("connections: expected a free place, got {MAX_CONNECTIONS}\n")));
        *refused.status_mut() = StatusCode::SERVICE_UNAVAILABLE;
        Err(refused)
    };
    let config = WebSocketConfig::default()
        .read_buffer_size(BUFFER_BYTES)
        .write_buffer_size(BUFFER_BYTES)
        .max_message_size(Some(MAX_BYTES))
        .max_frame_size(Some(MAX_BYTES));
    accept_hdr_async_with_config(stream, admit, Some(config)).await
}

async fn answer(core: &PlannerCore, payload: &[u8]) -> Message {
    let plan = async { core.plan(message::request(payload, || core.list_models())?).await.map_err(message::renamed) };
    plan.await.map_or_else(|error| refusal(&error), |plan| Message::binary(message::answer(plan)))
}

fn refusal(error: &Error) -> Message {
    Message::text(error.to_string())
}

fn too_long(bytes: usize) -> Error {
    Error::invalid("payload", format!("at most {MAX_BYTES} bytes"), format!("{bytes} bytes"))
}

async fn send(socket: &mut Socket, message: Message) -> Result<(), SocketError> {
    timeout(PATIENCE, socket.send(message)).await.map_err(too_slow)?
}

/// Says goodbye. What the client is sending still is read and forgotten: closed on it, it would not read why.
async fn hang_up(mut socket: Socket, code: CloseCode) -> Result<(), SocketError> {
    send(&mut socket, Message::Close(Some(CloseFrame { code, reason: "".into() }))).await?;
    let stream = socket.get_mut();
    stream.shutdown().await?;
    let mut rest = stream.take(16 * MAX_BYTES as u64);
    timeout(LINGER, tokio::io::copy(&mut rest, &mut tokio::io::sink())).await.map_err(too_slow)??;
    Ok(())
}

fn too_slow(silence: tokio::time::error::Elapsed) -> SocketError {
    SocketError::Io(silence.into())
}
