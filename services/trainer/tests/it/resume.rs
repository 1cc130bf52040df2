//! A real training run that is killed repeatedly has the result of an uninterrupted one.

use crate::common::{episode, keep};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::process::{Pid, Signal, kill_process};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;
use trainer::training::journal::{self, Entry};
use trainer::training::progress::Progress;
use trainer::training::tensorboard::{self, Content};

/// Steps of an epoch: 21 samples in batches of 2.
const STEPS_PER_EPOCH: u64 = 11;
const EPOCHS: u64 = 12;
const KILLS: usize = 10;

/// The files of one run.
struct Run {
    data: PathBuf,
    out: PathBuf,
    run_dir: PathBuf,
}

impl Run {
    fn new(folder: &Path, name: &str) -> Self {
        let data = folder.join("data");
        if !data.exists() {
            for (task, seed, steps) in [("reach", 1, 9), ("reach", 2, 7), ("door-lock", 1, 8)] {
                keep(&data, &episode(task, seed, steps));
            }
        }
        Self { data, out: folder.join(format!("{name}.safetensors")), run_dir: folder.join(name) }
    }

    /// Starts the real process, which saves its state after each step.
    fn start(&self, epochs: u64) -> Child {
        Command::new(env!("CARGO_BIN_EXE_cpn-trainer"))
            .args([
                "train",
                "--json",
                "--preset",
                "paper-bc",
                "--set",
                "training.batch_size=2",
                "--seed",
                "4",
                "--threads",
                "1",
            ])
            .args(["--save-interval-seconds", "0", "--set", &format!("training.epochs={epochs}")])
            .arg("--dataset")
            .arg(&self.data)
            .arg("--out")
            .arg(&self.out)
            .arg("--run-dir")
            .arg(&self.run_dir)
            .env("RUST_LOG", "warn")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap()
    }

    fn noted(&self) -> Vec<Entry> {
        journal::read(&self.run_dir).unwrap()
    }

    fn last_step(&self) -> u64 {
        self.noted().last().map_or(0, |entry| entry.progress.step)
    }

    /// Waits for the end of a step.
    fn reach(&self, step: u64, child: &mut Child) {
        while self.last_step() < step {
            assert!(child.try_wait().unwrap().is_none(), "the run ended before step {step}");
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Scalars of the only event file, as step, tag and value.
    fn events(&self) -> Vec<(u64, String, f32)> {
        let files: Vec<_> = std::fs::read_dir(&self.run_dir).unwrap().map(|entry| entry.unwrap().path()).collect();
        let mut files = files.iter().filter(|path| path.to_string_lossy().contains("tfevents"));
        let file = files.next().unwrap();
        assert_eq!(files.next(), None, "one event file");
        let mut scalars = Vec::new();
        for event in tensorboard::read(&std::fs::read(file).unwrap()) {
            let Some(Content::Summary(summary)) = event.content else { continue };
            let step = u64::try_from(event.step).unwrap();
            scalars.extend(summary.values.into_iter().map(|scalar| (step, scalar.tag, scalar.value.unwrap())));
        }
        scalars
    }
}

/// Noted progress without the fields that depend on the clock.
fn timeless(entries: &[Entry]) -> Vec<Progress> {
    entries.iter().map(|entry| Progress { samples_per_second: 0.0, ..entry.progress }).collect()
}

#[test]
fn a_killed_run_has_the_result_of_an_uninterrupted_one() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, broken) = (Run::new(folder.path(), "whole"), Run::new(folder.path(), "broken"));
    assert!(whole.start(EPOCHS).wait_with_output().unwrap().status.success());

    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for _ in 0..KILLS {
        let mut child = broken.start(EPOCHS);
        broken.reach(broken.last_step() + rng.random_range(1..4), &mut child);
        // Killed at a random moment: in a step, in a save, or between them.
        std::thread::sleep(Duration::from_micros(rng.random_range(0..20_000)));
        child.kill().unwrap();
        child.wait().unwrap();
        assert!(!broken.out.exists(), "killed before its end");
    }
    assert!(broken.start(EPOCHS).wait_with_output().unwrap().status.success());

    assert!(std::fs::read(&broken.out).unwrap() == std::fs::read(&whole.out).unwrap(), "the same weights, bit for bit");
    assert!(!broken.out.with_extension("resume").exists());
    let noted = broken.noted();
    for (noted, expected) in timeless(&noted).iter().zip(timeless(&whole.noted())) {
        assert_eq!(*noted, expected);
    }
    let steps: Vec<u64> = noted.iter().map(|entry| entry.progress.step).collect();
    assert_eq!(steps, (1..=EPOCHS * STEPS_PER_EPOCH).collect::<Vec<_>>());
    let expected: Vec<_> = noted.iter().map(|entry| (entry.progress.step, entry.progress.loss as f32)).collect();
    let losses = broken.events().into_iter().filter(|(_, tag, _)| tag == "train/loss");
    assert_eq!(losses.map(|(step, _, value)| (step, value)).collect::<Vec<_>>(), expected);
    let curve = std::fs::read_to_string(broken.run_dir.join("curve.svg")).unwrap();
    assert!(curve.contains("step 132 of 132") && curve.trim_end().ends_with("</svg>"));
}

#[test]
fn a_terminated_run_saves_its_state() {
    let folder = tempfile::tempdir().unwrap();
    let run = Run::new(folder.path(), "run");
    // So few epochs that every step is noted.
    let mut child = run.start(90);
    run.reach(3, &mut child);
    kill_process(Pid::from_child(&child), Signal::TERM).unwrap();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0));
    let lines = String::from_utf8(output.stdout).unwrap();
    let last: serde_json::Value = serde_json::from_str(lines.lines().last().unwrap()).unwrap();
    let step = run.last_step();
    assert_eq!(last, serde_json::json!({"interrupted": {"step": step}}));
    assert!(!run.out.exists());

    let mut child = run.start(90);
    run.reach(step + 1, &mut child);
    child.kill().unwrap();
    child.wait().unwrap();
    let steps: Vec<u64> = run.noted().iter().map(|entry| entry.progress.step).collect();
    assert!(steps.windows(2).all(|pair| pair[1] > pair[0]), "{steps:?}");
}

/// A run whose parent process has died, so that its output is closed, is interrupted.
#[test]
fn a_run_with_a_closed_output_saves_its_state() {
    let folder = tempfile::tempdir().unwrap();
    let run = Run::new(folder.path(), "run");
    let mut child = run.start(1000);
    run.reach(1, &mut child);
    drop(child.stdout.take());
    assert_eq!(child.wait().unwrap().code(), Some(0));
    assert!(run.out.with_extension("resume").exists());
}

#[test]
fn two_runs_do_not_share_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let run = Run::new(folder.path(), "run");
    let mut child = run.start(1000);
    run.reach(1, &mut child);
    let second = run.start(1000).wait_with_output().unwrap();
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!second.status.success());
}
