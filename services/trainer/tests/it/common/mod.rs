//! Fixtures: demonstrations, checkpoints, sessions and recorders.

mod episodes;

use cpn::{MethodKind, Model, checkpoint};
use recording::Episode;
use service_kit::SessionConfig;
use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use testing::process::{Log, PATIENCE, Process, free_address};
use testing::{provenance, small_config};
use trainer::record::folder::Recordings;
use wire::demonstration::CommitEpisodeRequest;
use wire::key;
use zenoh::Session;

pub use episodes::{SPEC, episode, info, keep, step, steps};

/// Data digest in the provenance of every checkpoint.
pub const DATA_DIGEST: &str = "dddddddddddddddddddddddddddddddddddddddddddddddddddddddddddddddd";

/// Commit of an episode.
pub fn commit(episode: &Episode) -> CommitEpisodeRequest {
    CommitEpisodeRequest { episode: episode.info().clone() }
}

/// Checkpoint of a small, random model.
pub fn checkpoint(seed: u64) -> Vec<u8> {
    checkpoint::to_bytes(&Model::new(small_config(MethodKind::Cpn), seed), &provenance(&["reach"], seed)).unwrap()
}

/// `cpn-trainer serve` in a process of its own, with a session to it.
pub struct Program {
    _process: Process,
    pub log: Log,
    pub session: Session,
    pub grpc: SocketAddr,
    pub metrics: SocketAddr,
}

/// Name of every trainer's process.
pub const NAME: &str = "under-test";

impl Program {
    /// Starts a trainer in a folder, with `data`, `checkpoints` and `runs`.
    pub async fn start(folder: &Path) -> Self {
        let (endpoint, grpc, metrics) = (format!("tcp/{}", free_address()), free_address(), free_address());
        let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-trainer"));
        command.args(["serve", "--name", NAME, "--listen", &endpoint, "--grpc-listen", &grpc.to_string()]);
        command.args(["--metrics-listen", &metrics.to_string()]).env_remove("RUST_LOG");
        for (option, name) in [("--dataset", "data"), ("--checkpoints", "checkpoints"), ("--runs", "runs")] {
            command.arg(option).arg(folder.join(name));
        }
        let (process, log) = Process::logged(&mut command);

        let config = SessionConfig { connect: vec![endpoint], ..SessionConfig::default() };
        let session = service_kit::session::open(&config).await.unwrap();
        let alive = session.liveliness().declare_subscriber(key::trainer_alive(NAME).unwrap()).history(true);
        tokio::time::timeout(PATIENCE, alive.await.unwrap().recv_async()).await.unwrap().unwrap();
        Self { _process: process, log, session, grpc, metrics }
    }
}

/// Two sessions: one listens, the other connects to it.
pub async fn sessions(endpoint: &str) -> (Session, Session) {
    let listening = SessionConfig { listen: vec![endpoint.into()], ..SessionConfig::default() };
    let connecting = SessionConfig { connect: vec![endpoint.into()], ..SessionConfig::default() };
    let listening = service_kit::session::open(&listening).await.unwrap();
    (listening, service_kit::session::open(&connecting).await.unwrap())
}

/// Bytes of all recordings of a folder, by relative path.
pub fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let paths = trainer::record::folder::paths(folder).unwrap();
    let name = |path: &Path| path.strip_prefix(folder).unwrap().display().to_string();
    paths.iter().map(|path| (name(path), std::fs::read(path).unwrap())).collect()
}

/// Recorder of `folder` on a session.
pub async fn record(
    session: &Session,
    folder: &Path,
    limits: trainer::record::ingest::Limits,
) -> (trainer::record::Recorder, Arc<Recordings>) {
    let recordings = Arc::new(Recordings::open(folder.to_owned()).unwrap());
    let ingest = Arc::new(trainer::record::ingest::Ingest::new(Arc::clone(&recordings), limits));
    (trainer::record::start(session, Arc::clone(&recordings), ingest).await.unwrap(), recordings)
}
