//! Processes of services, and what they listen on.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc;
use std::time::Duration;

/// Timeout that no passing test reaches.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// Ports of [`free_address`], below those of outgoing connections (from 32,768 on Linux), which could take one before a program does.
const PORTS: std::ops::Range<u32> = 10_000..32_768;

/// Address on loopback that nothing listens on; each call of a process returns another.
///
/// # Panics
///
/// If no port is free.
pub fn free_address() -> SocketAddr {
    static CALLS: AtomicU32 = AtomicU32::new(0);
    let candidate = || {
        // Processes at the same time begin apart.
        let number = std::process::id().wrapping_mul(97).wrapping_add(CALLS.fetch_add(1, Ordering::Relaxed));
        let port = (PORTS.start + number % PORTS.len() as u32) as u16;
        TcpListener::bind(("127.0.0.1", port)).and_then(|listener| listener.local_addr()).ok()
    };
    PORTS.into_iter().find_map(|_| candidate()).expect("a free port")
}

/// Process of a service, killed when dropped.
pub struct Process(pub Child);

impl Process {
    /// Starts a program; returns its process and the lines of its log.
    ///
    /// # Panics
    ///
    /// If the program cannot be started.
    pub fn logged(command: &mut Command) -> (Self, Log) {
        let mut child = command.stderr(Stdio::piped()).spawn().expect("a program");
        let (sender, lines) = mpsc::channel();
        let stderr = BufReader::new(child.stderr.take().expect("a pipe"));
        std::thread::spawn(move || stderr.lines().map_while(Result::ok).for_each(|line| drop(sender.send(line))));
        (Self(child), Log(lines))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Log of a process.
pub struct Log(mpsc::Receiver<String>);

impl Log {
    /// Next line that contains a text.
    ///
    /// # Panics
    ///
    /// If none comes.
    pub fn line(&self, text: &str) -> String {
        loop {
            let line = self.0.recv_timeout(PATIENCE).unwrap_or_else(|_| panic!("no line with {text:?} in the log"));
            if line.contains(text) {
                return line;
            }
        }
    }
}

/// Lines of a service's metrics.
///
/// # Panics
///
/// If the service does not answer with metrics.
pub fn scrape(address: SocketAddr) -> Vec<String> {
    let mut stream = TcpStream::connect(address).expect("a listener of metrics");
    write!(stream, "GET /metrics HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").expect("a request");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer in UTF-8");
    assert!(answer.starts_with("HTTP/1.1 200 OK"), "{answer}");
    answer.lines().map(str::to_owned).collect()
}
