//! TCP listener with a bounded number of connections, and TLS beyond the loopback interface.

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

/// Timeout of a TLS handshake.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);
/// Timeout of a client's first byte.
const FIRST_READ_TIMEOUT: Duration = Duration::from_secs(5);
/// Timeout between two reads from a client: longer than the keepalive intervals of the services.
const READ_TIMEOUT: Duration = Duration::from_secs(60);
/// Pause after a failed accept, as when file descriptors are used up.
const ACCEPT_RETRY: Duration = Duration::from_millis(200);

/// Settings of a listener.
#[derive(Debug, Clone)]
pub struct ListenConfig {
    /// Listening address; port 0 takes a free one.
    pub address: SocketAddr,
    /// TLS files, if encrypted.
    pub tls: Option<Tls>,
    /// Permission to listen beyond the loopback interface without TLS.
    pub insecure: bool,
    /// Maximum number of connections; further ones are closed at once.
    pub max_connections: usize,
}

/// Whether an address or host, with or without a port, is on the loopback interface.
pub fn is_loopback(address: &str) -> bool {
    let address = address.split(['?', '#']).next().unwrap_or_default();
    if let Ok(address) = address.parse::<SocketAddr>() {
        return address.ip().is_loopback();
    }
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
    host == "localhost" || host.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

/// TCP listener whose connections are accepted, and encrypted, in the background.
#[derive(Debug)]
pub struct Listener {
    address: SocketAddr,
    connections: mpsc::Receiver<Connection>,
    _task: AbortOnDropHandle<()>,
}

impl Listener {
    /// Binds a listener, called `name` in logs, metrics and errors; `protocols` are the ALPN protocols.
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

    /// Listening address.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Next connection, after its TLS handshake if there is TLS; none once the listener has ended.
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
                sleep(ACCEPT_RETRY).await;
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
            match handshake(stream, acceptor).await {
                Ok((stream, certificate)) => {
                    let peer = Peer { address, certificate };
                    let (read_timeout, last_read) = (Box::pin(sleep(FIRST_READ_TIMEOUT)), None);
                    // The listener may have ended.
                    let _ = sender.send(Connection { stream, peer, read_timeout, last_read, _place: place }).await;
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

/// TLS handshake, if there is an acceptor; returns the stream, and the common name of the client's certificate.
async fn handshake(stream: TcpStream, acceptor: Option<TlsAcceptor>) -> std::io::Result<(Stream, Option<String>)> {
    stream.set_nodelay(true)?;
    let Some(acceptor) = acceptor else { return Ok((Either::Left(stream), None)) };
    let stream = timeout(HANDSHAKE_TIMEOUT, acceptor.accept(stream)).await??;
    let certificates = stream.get_ref().1.peer_certificates();
    let name = certificates.and_then(<[_]>::first).and_then(tls::common_name);
    Ok((Either::Right(Box::new(stream)), name))
}

/// Connection to a client; reads fail when the client is silent beyond the timeout. Dropping it frees its place.
#[derive(Debug)]
pub struct Connection {
    stream: Stream,
    peer: Peer,
    read_timeout: Pin<Box<Sleep>>,
    last_read: Option<Instant>,
    _place: OwnedSemaphorePermit,
}

impl Connection {
    /// Remote side.
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
            Poll::Pending => self.poll_timeout(context),
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
    /// Pending until the read timeout expires, then an error. The timer is reset lazily, not with every read.
    fn poll_timeout(&mut self, context: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        while self.read_timeout.as_mut().poll(context).is_ready() {
            let until = self.last_read.map(|last_read| last_read + READ_TIMEOUT);
            match until.filter(|until| *until > Instant::now()) {
                Some(until) => self.read_timeout.as_mut().reset(until),
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
