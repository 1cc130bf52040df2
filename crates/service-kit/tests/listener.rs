//! Listener against silent clients, too many clients, and a lack of file descriptors: in a program of its own, whose limit it sets.

#![expect(clippy::unwrap_used, reason = "a test")]

use metrics_exporter_prometheus::PrometheusBuilder;
use service_kit::listener::{ListenConfig, Listener};
use std::fs::File;
use std::time::Duration;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};

const PATIENCE: Duration = Duration::from_secs(60);

async fn soon<T>(task: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, task).await.unwrap()
}

async fn listener(max_connections: usize) -> Listener {
    let address = "127.0.0.1:0".parse().unwrap();
    let config = ListenConfig { address, tls: None, insecure: false, max_connections };
    Listener::bind("test", config, &[]).await.unwrap()
}

/// A single test, since file descriptors and metrics are per process.
#[tokio::test(flavor = "multi_thread")]
async fn the_listener_survives_silent_clients_crowds_and_a_lack_of_file_descriptors() {
    let metrics = PrometheusBuilder::new().install_recorder().unwrap();
    let counted = |reason: &str| {
        let counter = format!("cpn_connections_refused_total{{listener=\"test\",reason=\"{reason}\"}}");
        metrics.render().lines().any(|line| line.starts_with(&counter))
    };

    let mut listener = listener(2).await;
    let mut silent = TcpStream::connect(listener.address()).await.unwrap();
    let mut talking = TcpStream::connect(listener.address()).await.unwrap();
    let (mut first, mut second) = (soon(listener.next()).await.unwrap(), soon(listener.next()).await.unwrap());
    if first.peer().address != silent.local_addr().unwrap() {
        std::mem::swap(&mut first, &mut second);
    }
    // No place is left.
    let mut third = TcpStream::connect(listener.address()).await.unwrap();
    assert_eq!(soon(third.read(&mut [0])).await.unwrap_or(0), 0);
    assert!(counted("full"));

    // The silent client is disconnected, which frees its place; the other, which sent a byte, stays.
    talking.write_all(b"a").await.unwrap();
    assert_eq!(soon(second.read_u8()).await.unwrap(), b'a');
    assert_eq!(soon(first.read_u8()).await.unwrap_err().kind(), std::io::ErrorKind::TimedOut);
    drop(first);
    assert_eq!(soon(silent.read(&mut [0])).await.unwrap_or(0), 0);
    let _fourth = TcpStream::connect(listener.address()).await.unwrap();
    let fourth = soon(listener.next()).await.unwrap();
    talking.write_all(b"b").await.unwrap();
    assert_eq!(soon(second.read_u8()).await.unwrap(), b'b');
    drop((second, fourth));

    // Without file descriptors no connection is accepted, and the client waits; with some, it is served.
    let client = TcpSocket::new_v4().unwrap();
    rustix::process::setrlimit(rustix::process::Resource::Nofile, limit(200)).unwrap();
    let mut files = Vec::new();
    while let Ok(file) = File::open("/dev/null") {
        files.push(file);
    }
    let _client = soon(client.connect(listener.address())).await.unwrap();
    soon(async {
        while !counted("system") {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    })
    .await;
    drop(files);
    soon(listener.next()).await.unwrap();
}

fn limit(files: u64) -> rustix::process::Rlimit {
    let hard = rustix::process::getrlimit(rustix::process::Resource::Nofile).maximum;
    rustix::process::Rlimit { current: Some(files), maximum: hard }
}
