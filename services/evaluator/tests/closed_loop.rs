//! The real thing: `cpn-eval` with a planner and simulator workers, each in its own process but the planner.
//!
//! Needs the simulator worker: `sim-worker/.venv/bin/cpn-sim-worker`, which `make setup` installs, or the command in
//! `CPN_SIM_WORKER`.

#![expect(clippy::unwrap_used, reason = "a test")]

use cpn::checkpoint::{self, Provenance};
use cpn::{Agent, EncoderConfig, MethodKind, ModelConfig};
use planner::Planner;
use service_kit::SessionConfig;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use tempfile::TempDir;
use tokio::process::{Child, Command};
use tokio::time::{sleep, timeout};

/// Far more than anything here takes; what does not end by then never will.
const LIMIT: Duration = Duration::from_secs(240);

/// A planner with an untrained model, and a place for workers.
struct Lab {
    folder: TempDir,
    planner: Option<Planner>,
    endpoint: String,
    namespace: String,
}

impl Lab {
    async fn start() -> Self {
        static LABS: AtomicUsize = AtomicUsize::new(0);
        let namespace = format!("test-{}-{}", std::process::id(), LABS.fetch_add(1, Ordering::SeqCst));
        let folder = tempfile::tempdir().unwrap();
        let provenance = Provenance {
            training_tasks: vec!["door-open".into()],
            data_digest: "0".repeat(64),
            render_spec: String::new(),
            seed: 0,
            training: cpn::Training::paper(),
        };
        let models_dir = folder.path().join("models");
        std::fs::create_dir(&models_dir).unwrap();
        let paper = ModelConfig::paper(MethodKind::Cpn);
        let of_positions =
            ModelConfig { encoder: EncoderConfig::position([600, 0, 200], 70), actions: 3, ..paper.clone() };
        for (name, config) in [("cpn", paper), ("jenga", of_positions)] {
            let bytes = checkpoint::to_bytes(&Agent::new(config, 0), &provenance).unwrap();
            std::fs::write(models_dir.join(name).with_extension("safetensors"), bytes).unwrap();
        }
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let endpoint = format!("tcp/127.0.0.1:{port}");
        let session =
            SessionConfig { listen: vec![endpoint.clone()], namespace: Some(namespace.clone()), ..Default::default() };
        let grpc_listen = "127.0.0.1:0".parse().unwrap();
        let config = planner::Config { models_dir, grpc_listen, session, ..Default::default() };
        Self { folder, planner: Some(planner::start(config).await.unwrap()), endpoint, namespace }
    }

    /// The planner goes away, unless it did before.
    async fn stop_planner(&mut self) {
        if let Some(planner) = self.planner.take() {
            planner.shutdown().await.unwrap();
        }
    }

    fn worker(&self, name: &str, max_steps: u32) -> Child {
        let installed = concat!(env!("CARGO_MANIFEST_DIR"), "/../../sim-worker/.venv/bin/cpn-sim-worker");
        let command = std::env::var("CPN_SIM_WORKER").unwrap_or_else(|_| installed.into());
        let mut words = command.split_whitespace();
        Command::new(words.next().unwrap())
            .args(words)
            .args(["serve", "--worker", name, "--max-steps", &max_steps.to_string()])
            .args(["--connect", &self.endpoint, "--namespace", &self.namespace])
            .stdin(Stdio::null())
            .kill_on_drop(true)
            .spawn()
            .unwrap_or_else(|e| panic!("{command}: {e}; run `make setup` or set CPN_SIM_WORKER"))
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("run")
    }

    fn evaluation(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-eval"));
        command.args(["run", "--connect", &self.endpoint, "--namespace", &self.namespace]).args(["--out"]);
        command.arg(self.out()).args(arguments).kill_on_drop(true).stdin(Stdio::null());
        command
    }

    async fn evaluate(&self, arguments: &[&str]) -> Ended {
        Ended::of(self.evaluation(arguments).output()).await
    }
}

/// What a finished `cpn-eval` said.
struct Ended {
    success: bool,
    stdout: String,
    stderr: String,
}

impl Ended {
    async fn of(output: impl Future<Output = std::io::Result<Output>>) -> Self {
        let output = timeout(LIMIT, output).await.expect("cpn-eval ends").unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        let ended = Self { success: output.status.success(), stdout: text(output.stdout), stderr: text(output.stderr) };
        println!("{}\n{}", ended.stderr, ended.stdout);
        ended
    }
}

fn record(out: &Path, name: &str) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(out.join("trials").join(name)).unwrap()).unwrap()
}

/// The files under a folder with their contents.
fn files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(self::files(&path));
        } else {
            files.push((path.clone(), std::fs::read(path).unwrap()));
        }
    }
    files.sort();
    files
}

/// A task whose goal is a position is asked by position; a model of pictures does not take it.
#[tokio::test(flavor = "multi_thread")]
async fn a_model_of_positions_is_told_positions() {
    let mut lab = Lab::start().await;
    let _worker = lab.worker("w0", 3);
    let arguments = ["--workers", "1", "--tasks", "jenga-poke-offset", "--trials", "1", "--wait-secs", "120"];
    let ended = lab.evaluate(&[&arguments[..], &["--models", "jenga"]].concat()).await;
    assert!(ended.success);
    let record = record(&lab.out(), "jenga-poke-offset/jenga/1000000.json");
    assert_eq!(record["outcome"], "failure");
    assert_eq!(record["episode"]["steps"], 3);
    assert_eq!(record["episode"]["latent_distances"].as_array().unwrap().len(), 3);
    let refused = lab.evaluate(&[&arguments[..], &["--models", "cpn"]].concat()).await;
    assert!(!refused.success);
    assert!(refused.stderr.contains("goal_position"), "{}", refused.stderr);
    lab.stop_planner().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_model_is_run_on_the_same_variations_and_reported() {
    let mut lab = Lab::start().await;
    let _workers = [lab.worker("w0", 12), lab.worker("w1", 12)];
    // The expert does not solve seed 2 of this task.
    let arguments = ["--workers", "2", "--tasks", "door-open", "--models", "cpn,random", "--trials", "2"];
    let arguments = [&arguments[..], &["--first-seed", "1", "--wait-secs", "120", "--timeout-secs", "60"]].concat();
    let ended = lab.evaluate(&arguments).await;
    assert!(ended.success);

    let out = lab.out();
    let names: Vec<_> = files(&out.join("trials")).into_iter().map(|(path, _)| path).collect();
    let expected = ["cpn/1.json", "cpn/3.json", "random/1.json", "random/3.json"];
    assert_eq!(names, expected.map(|name| out.join("trials/door-open").join(name)));
    let cpn = record(&out, "door-open/cpn/3.json");
    assert_eq!((&cpn["outcome"], &cpn["episode"]["steps"]), (&"failure".into(), &12.into()));
    assert_eq!(cpn["episode"]["latent_distances"].as_array().unwrap().len(), 12);
    assert_eq!(cpn["episode"]["last_inner_losses"].as_array().unwrap().len(), 2);
    let random = record(&out, "door-open/random/3.json");
    assert_eq!(random["episode"]["goal_id"], cpn["episode"]["goal_id"], "the same variation has the same goal image");
    assert!(random["episode"]["latent_distances"].as_array().unwrap().is_empty());

    for (model, training) in [("cpn", "trained"), ("random", "–")] {
        let row = ended.stdout.lines().find(|line| line.contains(model)).unwrap();
        let cells: Vec<_> = row.split_whitespace().collect();
        assert_eq!(cells[..6], ["door-open", model, training, "0/2", "0", "%"], "{row}");
    }
    let html = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert_eq!(html.matches("data:image/png;base64,").count(), 2 * 9, "goal and eight frames of one failure each");

    // Nothing is left to do, so that nothing changes.
    let (trials, frames) = (files(&out.join("trials")), files(&out.join("frames")));
    let ended = lab.evaluate(&[&arguments[..], &["--json"]].concat()).await;
    assert!(ended.success);
    assert!(ended.stderr.contains("4 of 4 trials are there already"));
    assert_eq!((files(&out.join("trials")), files(&out.join("frames"))), (trials, frames));
    let summary: serde_json::Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(summary["rows"][1]["trials"], 2);
    lab.stop_planner().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_worker_leaves_errors_and_no_hang() {
    lose(Lost::Worker).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_planner_that_goes_leaves_errors_and_no_hang() {
    lose(Lost::Planner).await;
}

enum Lost {
    Worker,
    Planner,
}

/// Loses a part in the middle of an evaluation.
async fn lose(lost: Lost) {
    let mut lab = Lab::start().await;
    let mut worker = lab.worker("w0", 150);
    let arguments = ["--tasks", "reach", "--models", "random,cpn", "--trials", "5", "--wait-secs", "120"];
    // One trial, to know that all is well and to give up soon on what is lost below.
    let one = lab.evaluate(&[&arguments[..4], &["--trials", "1", "--wait-secs", "120"]].concat()).await;
    assert!(one.success);

    let arguments = [&arguments[..6], &["--wait-secs", "2", "--timeout-secs", "5"]].concat();
    let evaluation = lab.evaluation(&arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let second = lab.out().join("trials/reach/random/1000001.json");
    timeout(LIMIT, async {
        while !second.exists() {
            sleep(Duration::from_millis(20)).await;
        }
    })
    .await
    .expect("the first new trial ends");
    match lost {
        Lost::Worker => worker.kill().await.unwrap(),
        Lost::Planner => lab.stop_planner().await,
    }

    let ended = Ended::of(evaluation.wait_with_output()).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains("trials could not be brought to an end"));
    let outcomes: Vec<_> = files(&lab.out().join("trials"))
        .iter()
        .map(|(_, bytes)| serde_json::from_slice::<serde_json::Value>(bytes).unwrap())
        .collect();
    assert_eq!(outcomes.len(), 10, "every trial is accounted for");
    let errors: Vec<_> = outcomes.iter().filter(|trial| trial["outcome"] == "error").collect();
    assert!((1..8).contains(&errors.len()), "{} errors", errors.len());
    assert!(errors.iter().all(|trial| !trial["message"].as_str().unwrap().is_empty()));
    assert!(ended.stdout.contains("reach, cpn: "), "the table says what went wrong");
    lab.stop_planner().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_evaluated_is_named() {
    let mut lab = Lab::start().await;
    let ended = lab.evaluate(&["--tasks", "reach", "--planner", "nobody", "--wait-secs", "1"]).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains("after 1 s still without planner \"nobody\" and simulator workers (0 of 1 there)"));

    let _worker = lab.worker("w0", 5);
    let ended = lab.evaluate(&["--tasks", "reach", "--models", "cpn,upn", "--wait-secs", "120"]).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains("--models: planner \"planner\" serves cpn, jenga, random; got upn"));

    let ended = lab.evaluate(&["--tasks", "reach-the-moon"]).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains("refused: variation.task: expected one of assembly, "));
    assert!(ended.stderr.contains("got 'reach-the-moon'"));

    // The folder is now that of a run with goals of the same variation.
    let ended = lab.evaluate(&["--tasks", "reach", "--goal", "other-variation"]).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains("--out: expected a folder of --goal \"other-variation\", got "));
    assert!(ended.stderr.contains("of \"same-variation\""));
    lab.stop_planner().await;
}
