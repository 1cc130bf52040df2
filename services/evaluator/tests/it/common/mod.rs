//! A planner on loopback, and `cpn-eval` as a process that joins it.

use cpn::checkpoint::{self, Provenance};
use cpn::{EncoderConfig, MethodKind, Model, ModelConfig};
use planner::Planner;
use service_kit::SessionConfig;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use tempfile::TempDir;
use tokio::process::Command;
use tokio::time::timeout;
use wire::planner::{CheckpointSource, LoadModelRequest};

/// Far more than anything here takes; what does not end by then never will.
pub const LIMIT: Duration = Duration::from_secs(240);

/// A planner with untrained models, and a place for workers.
pub struct Lab {
    pub folder: TempDir,
    planner: Option<Planner>,
    pub endpoint: String,
    pub namespace: String,
}

impl Lab {
    /// The models "cpn" of pictures and "jenga" of positions, with weights drawn from `seed`.
    pub async fn start(seed: u64) -> Self {
        static LABS: AtomicUsize = AtomicUsize::new(0);
        let namespace = format!("test-{}-{}", std::process::id(), LABS.fetch_add(1, Ordering::SeqCst));
        let folder = tempfile::tempdir().unwrap();
        let models_dir = models(folder.path(), seed);
        let endpoint = free_endpoint();
        let session =
            SessionConfig { listen: vec![endpoint.clone()], namespace: Some(namespace.clone()), ..Default::default() };
        let grpc_listen = "127.0.0.1:0".parse().unwrap();
        let config = planner::Config { models_dir, grpc_listen, session, ..Default::default() };
        Self { folder, planner: Some(planner::start(config).await.unwrap()), endpoint, namespace }
    }

    /// The planner goes away, unless it did before.
    pub async fn stop_planner(&mut self) {
        if let Some(planner) = self.planner.take() {
            planner.shutdown().await.unwrap();
        }
    }

    /// The planner serves the model "cpn" under one more name.
    pub async fn serve_as(&self, name: &str) {
        let source = CheckpointSource::File("cpn.safetensors".into());
        let load = LoadModelRequest { model: name.into(), source };
        self.planner.as_ref().unwrap().core().load_model(load).await.unwrap();
    }

    pub fn out(&self) -> PathBuf {
        self.folder.path().join("run")
    }

    pub fn evaluation(&self, arguments: &[&str]) -> Command {
        let mut command = self.command("run");
        command.arg("--out").arg(self.out()).args(arguments);
        command
    }

    fn command(&self, verb: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-eval"));
        command.args([verb, "--connect", &self.endpoint, "--namespace", &self.namespace]);
        command.kill_on_drop(true).stdin(Stdio::null());
        command
    }

    pub async fn evaluate(&self, arguments: &[&str]) -> Ended {
        Ended::of(self.evaluation(arguments).output()).await
    }

    /// Plays the file of a trial of some run back through this planner.
    pub async fn replay(&self, file: &Path) -> Ended {
        Ended::of(self.command("replay").arg(file).output()).await
    }
}

/// A folder in `folder` with the models "cpn" of pictures and "jenga" of positions, with weights drawn from `seed`.
pub fn models(folder: &Path, seed: u64) -> PathBuf {
    let provenance = Provenance {
        training_tasks: vec!["door-open".into()],
        data_digest: "0".repeat(64),
        render_spec: String::new(),
        seed: 0,
        training: cpn::Training::paper(),
    };
    let models_dir = folder.join("models");
    std::fs::create_dir(&models_dir).unwrap();
    let paper = ModelConfig::paper(MethodKind::Cpn);
    let of_positions = ModelConfig { encoder: EncoderConfig::position([600, 0, 200], 70), actions: 3, ..paper.clone() };
    for (name, config) in [("cpn", paper), ("jenga", of_positions)] {
        let bytes = checkpoint::to_bytes(&Model::new(config, seed), &provenance).unwrap();
        std::fs::write(models_dir.join(name).with_extension("safetensors"), bytes).unwrap();
    }
    models_dir
}

/// An endpoint on the loopback that nobody listens on.
pub fn free_endpoint() -> String {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    format!("tcp/127.0.0.1:{port}")
}

/// What a finished `cpn-eval` said.
pub struct Ended {
    pub success: bool,
    pub stdout: String,
    pub stderr: String,
}

impl Ended {
    pub async fn of(output: impl Future<Output = std::io::Result<Output>>) -> Self {
        let output = timeout(LIMIT, output).await.expect("cpn-eval ends").unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        let ended = Self { success: output.status.success(), stdout: text(output.stdout), stderr: text(output.stderr) };
        println!("{}\n{}", ended.stderr, ended.stdout);
        ended
    }
}
