//! Listening: bounded connections, with TLS beyond the loopback interface.

use crate::access::Peer;
use crate::tls::{self, Tls};
use anyhow::{Context as _, ensure};
use metrics::counter;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::time::{Instant, Sleep, sleep, timeout};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tokio_util::either::Either;
use tokio_util::task::AbortOnDropHandle;
use tonic::transport::server::Connected;
use tracing::warn;

/// Time that a client has for its TLS handshake.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);
/// Time that a client has for its first byte, and then from one to the next: what is served here asks silent clients for a
/// sign of life more often than that.
const SILENCE: [Duration; 2] = [Duration::from_secs(5), Duration::from_secs(60)];
/// Pause after the system has refused a connection, as when file descriptors are used up.
const PAUSE: Duration = Duration::from_millis(200);

/// Settings of a listener.
#[derive(Debug, Clone)]
pub struct ListenConfig {
    /// Where to listen; port 0 takes a free one.
    pub address: SocketAddr,
    /// Encryption, if any.
    pub tls: Option<Tls>,
    /// Allows an address beyond the loopback interface without TLS.
    pub insecure: bool,
    /// Most connections at the same time; one more is closed at once.
    pub max_connections: usize,
}

/// Whether an address or host, with or without a port, is of the loopback interface.
pub fn is_loopback(address: &str) -> bool {
    let address = address.split(['?', '#']).next().unwrap_or_default();
    if let Ok(address) = address.parse::<SocketAddr>() {
        return address.ip().is_loopback();
    }
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
    host == "localhost" || host.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

/// Accepts connections.
#[derive(Debug)]
pub struct Listener {
    address: SocketAddr,
    connections: mpsc::Receiver<Connection>,
    _task: AbortOnDropHandle<()>,
}

impl Listener {
    /// Listens, in the name of `name` in logs and errors; `protocols` are those of TLS's negotiation (ALPN).
    ///
    /// # Errors
    /// If the address cannot be listened on, or is beyond the loopback interface without TLS, or a TLS file cannot be used.
    pub async fn bind(name: &'static str, config: ListenConfig, protocols: &[&[u8]]) -> anyhow::Result<Self> {
        let ListenConfig { address, tls, insecure, max_connections } = config;
        ensure!(
            tls.is_some() || insecure || address.ip().is_loopback(),
            "{name} on {address}: expected TLS (tls_ca, tls_certificate, tls_private_key) beyond the loopback interface, or \
             insecure to be set, got neither"
        );
        let acceptor = tls.map(|tls| tls.server(protocols)).transpose()?.map(TlsAcceptor::from);
        let listener = TcpListener::bind(address).await.with_context(|| format!("{name} on {address}"))?;
        let address = listener.local_addr()?;
        let (sender, connections) = mpsc::channel(1);
        let task = AbortOnDropHandle::new(tokio::spawn(accept(name, listener, acceptor, max_connections, sender)));
        Ok(Self { address, connections, _task: task })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The next connection, encrypted already if it is to be; none once the listener has ended.
    pub async fn next(&mut self) -> Option<Connection> {
        self.connections.recv().await
    }
}

async fn accept(
    name: &'static str,
    listener: TcpListener,
    acceptor: Option<TlsAcceptor>,
    max_connections: usize,
    sender: mpsc::Sender<Connection>,
) {
    let places = Arc::new(Semaphore::new(max_connections));
    loop {
        let (stream, address) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                count_refusal(name, "system");
                warn!(listener = name, %error, "a connection was not accepted");
                sleep(PAUSE).await;
                continue;
            }
        };
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else {
            count_refusal(name, "full");
            warn!(listener = name, client = %address, max_connections, "a connection was refused: all places are taken");
            continue;
        };
        let (acceptor, sender) = (acceptor.clone(), sender.clone());
        tokio::spawn(async move {
            match shake_hands(stream, acceptor).await {
                Ok((stream, certificate)) => {
                    let peer = Peer { address, certificate };
                    let (patience, last_read) = (Box::pin(sleep(SILENCE[0])), None);
                    // The listener may have ended.
                    let _ = sender.send(Connection { stream, peer, patience, last_read, _place: place }).await;
                }
                Err(error) => {
                    count_refusal(name, "handshake");
                    warn!(listener = name, client = %address, %error, "a TLS handshake failed");
                }
            }
        });
    }
}

fn count_refusal(listener: &'static str, reason: &'static str) {
    counter!("cpn_connections_refused_total", "listener" => listener, "reason" => reason).increment(1);
}

type Stream = Either<TcpStream, Box<TlsStream<TcpStream>>>;

/// Encrypts the stream, if it is to be; answers the common name of the client's certificate, too.
async fn shake_hands(stream: TcpStream, acceptor: Option<TlsAcceptor>) -> std::io::Result<(Stream, Option<String>)> {
    stream.set_nodelay(true)?;
    let Some(acceptor) = acceptor else { return Ok((Either::Left(stream), None)) };
    let stream = timeout(HANDSHAKE_TIMEOUT, acceptor.accept(stream)).await??;
    let certificates = stream.get_ref().1.peer_certificates();
    let name = certificates.and_then(<[_]>::first).and_then(tls::common_name);
    Ok((Either::Right(Box::new(stream)), name))
}

/// A connection to a client, which ends in an error when the client says nothing for too long. Its place is free again
/// when it is dropped.
#[derive(Debug)]
pub struct Connection {
    stream: Stream,
    peer: Peer,
    patience: Pin<Box<Sleep>>,
    last_read: Option<Instant>,
    _place: OwnedSemaphorePermit,
}

impl Connection {
    /// The other side.
    pub fn peer(&self) -> &Peer {
        &self.peer
    }
}

impl Connected for Connection {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        to: &mut ReadBuf<'_>,
    ) -> Poll<std::io::Result<()>> {
        let before = to.filled().len();
        match Pin::new(&mut self.stream).poll_read(context, to) {
            Poll::Pending => self.poll_silence(context),
            ready => {
                if to.filled().len() > before {
                    self.last_read = Some(Instant::now());
                }
                ready
            }
        }
    }
}

impl Connection {
    /// Pending until the client has been silent for too long.
    fn poll_silence(&mut self, context: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        while self.patience.as_mut().poll(context).is_ready() {
            let until = self.last_read.map(|last_read| last_read + SILENCE[1]);
            match until.filter(|until| *until > Instant::now()) {
                Some(until) => self.patience.as_mut().reset(until),
                None => return Poll::Ready(Err(std::io::ErrorKind::TimedOut.into())),
            }
        }
        Poll::Pending
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, from: &[u8]) -> Poll<std::io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, from)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        from: &[std::io::IoSlice<'_>],
    ) -> Poll<std::io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, from)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}
