//! The real thing: `cpn-eval` with a planner and simulator workers, each in its own process but the planner.
//!
//! Needs the simulator worker: `sim-worker/.venv/bin/cpn-sim-worker`, which `make setup` installs, or the command in
//! `CPN_SIM_WORKER`.

use crate::common::{Ended, LIMIT, Lab};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;
use tokio::process::{Child, Command};
use tokio::time::{sleep, timeout};

fn worker(lab: &Lab, name: &str, max_steps: u32) -> Child {
    let installed = concat!(env!("CARGO_MANIFEST_DIR"), "/../../sim-worker/.venv/bin/cpn-sim-worker");
    let command = std::env::var("CPN_SIM_WORKER").unwrap_or_else(|_| installed.into());
    let mut words = command.split_whitespace();
    Command::new(words.next().unwrap())
        .args(words)
        .args(["serve", "--worker", name, "--max-steps", &max_steps.to_string()])
        .args(["--connect", &lab.endpoint, "--namespace", &lab.namespace])
        .stdin(Stdio::null())
        .kill_on_drop(true)
        .spawn()
        .unwrap_or_else(|e| panic!("{command}: {e}; run `make setup` or set CPN_SIM_WORKER"))
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
    let mut lab = Lab::start(0).await;
    let _worker = worker(&lab, "w0", 3);
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
    let mut lab = Lab::start(0).await;
    let _workers = [worker(&lab, "w0", 12), worker(&lab, "w1", 12)];
    // The expert does not solve seed 2 of this task.
    let arguments = ["--workers", "2", "--tasks", "door-open", "--models", "cpn,random", "--trials", "2"];
    let arguments = [&arguments[..], &["--first-seed", "1", "--wait-secs", "120", "--timeout-secs", "60"]].concat();
    let ended = lab.evaluate(&arguments).await;
    assert!(ended.success);

    let out = lab.out();
    let names: Vec<_> = files(&out.join("trials")).into_iter().map(|(path, _)| path).collect();
    let trials = ["cpn/1", "cpn/3", "random/1", "random/3"].map(|name| out.join("trials/door-open").join(name));
    let expected = trials.each_ref().map(|trial| [trial.with_extension("json"), trial.with_extension("mcap")]);
    assert_eq!(names, expected.as_flattened());
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
    assert!(ended.stdout.contains("not an evaluation: the seeds are those of demonstrations"));
    let html = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert_eq!(html.matches("data:image/png;base64,").count(), 2 * 9, "goal and eight frames of one failure each");

    for trial in trials {
        let replayed = lab.replay(&trial.with_extension("mcap")).await;
        assert_eq!((replayed.success, replayed.stdout.as_str()), (true, "12 plans: bit for bit the same\n"));
    }

    // Nothing is left to do, so that nothing changes.
    let trials = files(&out.join("trials"));
    let ended = lab.evaluate(&[&arguments[..], &["--json"]].concat()).await;
    assert!(ended.success);
    assert!(ended.stderr.contains("4 of 4 trials are there already"));
    assert_eq!(files(&out.join("trials")), trials);
    let summary: serde_json::Value = serde_json::from_str(&ended.stdout).unwrap();
    assert_eq!(summary["rows"][1]["trials"], 2);
    lab.stop_planner().await;
}

/// Rest solves nothing, the straight line reaches; and plans are asked for and carried out as they are set.
#[tokio::test(flavor = "multi_thread")]
async fn controls_stand_beside_models_whose_plans_are_set() {
    let mut lab = Lab::start(0).await;
    let _worker = worker(&lab, "w0", 60);
    let arguments = ["--tasks", "reach", "--models", "no-op,oracle,cpn", "--trials", "1", "--wait-secs", "120"];
    let planning = ["--updates", "2", "--warm-start", "--apply-actions", "2"];
    let ended = lab.evaluate(&[&arguments[..], &planning].concat()).await;
    assert!(ended.success);
    assert!(ended.stdout.contains("plans: --updates 2 --warm-start --apply-actions 2"));

    let [rest, line, cpn] =
        ["no-op", "oracle", "cpn"].map(|model| record(&lab.out(), &format!("reach/{model}/1000000.json")));
    assert_eq!((&rest["outcome"], &rest["episode"]["steps"]), (&"failure".into(), &60.into()));
    assert_eq!((&line["outcome"], &line["model_digest"]), (&"success".into(), &"".into()));
    assert_eq!(rest["episode"]["goal_id"], cpn["episode"]["goal_id"]);
    let progress = |record: &serde_json::Value| {
        record["episode"]["progress"].as_array().unwrap().iter().map(|it| it.as_f64().unwrap()).collect::<Vec<_>>()
    };
    let (rest, line, steps) = (progress(&rest), progress(&line), line["episode"]["steps"].as_u64().unwrap());
    assert_eq!((rest.len(), line.len() as u64), (61, steps + 1));
    assert!((rest[0] - line[0]).abs() < 1e-12 && rest[60] < rest[0] + 0.01 && line[line.len() - 1] > 0.9);
    let file = lab.out().join("trials/reach/oracle/1000000.mcap");
    let recorded = recording::trial::read(&file).unwrap();
    assert_eq!((recorded.frames().len() as u64, recorded.exchanges().len()), (steps + 1, 0), "no planner was asked");
    let refused = lab.replay(&file).await;
    assert!(refused.stderr.contains("1000000.mcap: expected plans, got a trial of oracle"), "{}", refused.stderr);

    assert_eq!(cpn["planning"]["updates"], 2);
    let episode = &cpn["episode"];
    assert_eq!(
        episode["plan_steps"].as_array().unwrap().iter().map(|it| it.as_u64().unwrap()).collect::<Vec<_>>(),
        (0..30).map(|plan| 2 * plan).collect::<Vec<_>>()
    );
    assert_eq!(episode["last_inner_losses"].as_array().unwrap().len(), 3, "before each update and after the last");
    let file = lab.out().join("trials/reach/cpn/1000000.mcap");
    let recorded = recording::trial::read(&file).unwrap();
    assert_eq!((recorded.frames().len(), recorded.exchanges()[1].step), (61, 2), "frames between plans are there");
    let starts: Vec<_> = recorded.exchanges().iter().map(|exchange| &exchange.request.warm_start).collect();
    assert!(starts[0].is_empty());
    assert_eq!(starts[1][0], recorded.exchanges()[0].response.actions[2], "two actions further on");
    let replayed = lab.replay(&file).await;
    assert_eq!((replayed.success, replayed.stdout.as_str()), (true, "30 plans: bit for bit the same\n"));

    let refused = async |arguments: &[&str], refusal: &str| {
        let ended = lab.evaluate(&[&["--tasks", "reach", "--trials", "1"], arguments].concat()).await;
        assert!(!ended.success && ended.stderr.contains(refusal), "{}", ended.stderr);
    };
    let cpn = ["--models", "cpn"];
    refused(&[&cpn[..], &["--updates", "3"]].concat(), "--out: expected a folder of --updates 3, got ").await;
    std::fs::remove_dir_all(lab.out()).unwrap();
    let refusal = "--apply-actions: expected at most 5, the horizon of cpn, got 9";
    refused(&[&cpn[..], &["--apply-actions", "9"]].concat(), refusal).await;
    let refusal = "--updates 3: expected a model that plans, got no-op";
    refused(&["--models", "no-op", "--updates", "3"], refusal).await;
    let refusal = "samples: expected none for GRADIENT, got 9";
    refused(&["--solver", "gradient", "--samples", "9"], refusal).await;
    lab.serve_as("oracle").await;
    let refusal = "--models: expected oracle to be the control only, got a model of that name from planner \"planner\"";
    refused(&["--models", "oracle"], refusal).await;
    lab.stop_planner().await;
}

/// While a plan is made, the simulation goes on by at least one step.
#[tokio::test(flavor = "multi_thread")]
async fn in_real_time_the_first_plan_comes_too_late_for_the_first_step() {
    let mut lab = Lab::start(0).await;
    let _worker = worker(&lab, "w0", 12);
    let arguments =
        ["--tasks", "reach", "--models", "oracle,cpn", "--trials", "1", "--wait-secs", "120", "--real-time"];
    assert!(lab.evaluate(&arguments).await.success);
    let [line, cpn] = ["oracle", "cpn"].map(|model| record(&lab.out(), &format!("reach/{model}/1000000.json")));
    assert_eq!((&line["planning"]["real_time"], &line["episode"]["steps"]), (&true.into(), &12.into()));
    let recorded = recording::trial::read(&lab.out().join("trials/reach/cpn/1000000.mcap")).unwrap();
    let late = |times: wire::planner::StageTimes| {
        let seconds = times.queue_seconds + times.encode_seconds + times.plan_seconds;
        (80.0 * seconds).ceil().max(1.0) as u64
    };
    let waits: Vec<_> = recorded.exchanges().iter().map(|exchange| late(exchange.response.times)).collect();
    let (last, before) = waits.split_last().unwrap();
    let before: u64 = before.iter().sum();
    assert!(before < 12 && before + last >= 12, "{waits:?}");
    assert_eq!(cpn["episode"]["steps"], 12);
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
    let mut lab = Lab::start(0).await;
    let mut worker = worker(&lab, "w0", 150);
    let arguments = ["--tasks", "reach", "--models", "random,cpn", "--trials", "5", "--wait-secs", "120"];
    // One trial, to know that all is well and to give up soon on what is lost below.
    let one = lab.evaluate(&[&arguments[..4], &["--trials", "1", "--wait-secs", "120"]].concat()).await;
    assert!(one.success);

    let arguments = [&arguments[..6], &["--wait-secs", "2", "--timeout-secs", "5", "--recovery-secs", "1"]].concat();
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
        .filter(|(path, _)| path.extension().is_some_and(|extension| extension == "json"))
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
    let mut lab = Lab::start(0).await;
    let ended = lab.evaluate(&["--tasks", "reach", "--planner", "nobody", "--wait-secs", "1"]).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains("after 1 s still without planner \"nobody\" and simulator workers (0 of 1 there)"));

    let _worker = worker(&lab, "w0", 5);
    let ended = lab.evaluate(&["--tasks", "reach", "--models", "cpn,upn", "--wait-secs", "120"]).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains("--models: planner \"planner\" serves cpn, jenga, random; got upn"));

    // Nothing is run, though some of it could be.
    for tasks in ["reach-the-moon", "reach,reach-the-moon"] {
        let ended = lab.evaluate(&["--tasks", tasks, "--models", "random"]).await;
        assert!(!ended.success);
        assert!(
            ended
                .stderr
                .contains("reach-the-moon 1000000, worker w0: refused: variation.task: expected one of assembly, ")
        );
        assert!(ended.stderr.contains("got 'reach-the-moon'"));
    }
    let ended = lab.evaluate(&["--tasks", "reach,jenga-poke-offset", "--models", "random,cpn"]).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains("jenga-poke-offset 1000000, cpn: refused: "), "{}", ended.stderr);
    let ended = lab.evaluate(&["--tasks", "reach,"]).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains("--tasks: expected names, got \"reach,\""), "{}", ended.stderr);
    assert_eq!(files(&lab.out()).len(), 1, "there is nothing but the lock");

    let ended = lab.evaluate(&["--tasks", "reach", "--models", "random", "--trials", "1"]).await;
    assert!(ended.success);
    // The folder is now that of a run with goals of the same variation.
    let ended = lab.evaluate(&["--tasks", "reach", "--goal", "other-variation"]).await;
    assert!(!ended.success);
    assert!(ended.stderr.contains("--out: expected a folder of --goal \"other-variation\", got "));
    assert!(ended.stderr.contains("of \"same-variation\""));
    lab.stop_planner().await;
}
