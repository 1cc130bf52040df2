//! The report is made from the records alone.

#![expect(clippy::unwrap_used, reason = "a test")]

use evaluator::{Episode, FORMAT, Folder, GoalSource, Model, Outcome, Run, StageTimes, Trial};

fn model(name: &str, digest: &str, training_tasks: &[&str]) -> Model {
    Model {
        name: name.into(),
        method: name.into(),
        digest: digest.repeat(64),
        training_tasks: training_tasks.iter().map(ToString::to_string).collect(),
        horizon: 5,
    }
}

fn run() -> Run {
    Run {
        format: FORMAT,
        title: "Lock & drawer".into(),
        command: "cpn-eval run --tasks door-lock,drawer-close".into(),
        date: "2026-01-02T03:04:05Z".into(),
        planners: vec!["planner-0".into(), "planner-1".into()],
        models: vec![model("cpn", "a", &["drawer-close", "reach"]), model("random", "b", &[])],
        tasks: vec!["door-lock".into(), "drawer-close".into()],
        trials: 4,
        first_seed: 10,
        goal: GoalSource::SameVariation,
    }
}

fn trial(task: &str, model: &Model, seed: u64, outcome: Outcome, steps: u32) -> Trial {
    let episode = Episode {
        goal_id: "c".repeat(64),
        steps,
        latent_distances: vec![Some(1.5); steps as usize],
        first_inner_losses: vec![Some(2.0), None],
        last_inner_losses: vec![],
        mean_times: StageTimes::default(),
    };
    let (task, model, model_digest) = (task.into(), model.name.clone(), model.digest.clone());
    let goal = GoalSource::SameVariation;
    Trial { format: FORMAT, task, seed, model, model_digest, goal, outcome, episode: Some(episode) }
}

/// Seed 12 of door-lock has no goal image; one trial of drawer-close was never brought to an end.
fn folder() -> (tempfile::TempDir, Folder) {
    let root = tempfile::tempdir().unwrap();
    let (folder, run) = (Folder::new(root.path()), run());
    folder.write_run(&run).unwrap();
    let outcome = |success: bool| if success { Outcome::Success } else { Outcome::Failure };
    for (index, model) in run.models.iter().enumerate() {
        for (seed, steps) in [(10, 40), (11, 50), (13, 60), (14, 150)] {
            let trial = trial("door-lock", model, seed, outcome(index == 0 && steps < 150), steps);
            folder.write_trial(&trial).unwrap();
        }
        for seed in 10..14 {
            folder.write_trial(&trial("drawer-close", model, seed, outcome(seed == 10), 30)).unwrap();
        }
    }
    let message = "worker w0: step: expected <an answer>, got none".into();
    let error = trial("drawer-close", &run.models[0], 13, Outcome::Error { message }, 0);
    folder.write_trial(&Trial { episode: None, ..error }).unwrap();
    (root, folder)
}

#[test]
fn the_table_has_a_row_for_each_task_and_model() {
    let (root, _) = folder();
    let summary = evaluator::report(root.path()).unwrap();
    insta::assert_snapshot!(evaluator::table(&summary), @r"
    ──────────────────────────────────────────────────────────────────────────────────────
     task           model    task was   successes   rate   95 % interval   steps   errors 
    ══════════════════════════════════════════════════════════════════════════════════════
     door-lock      cpn      held out         3/4   75 %      30 to 95 %      50        – 
     door-lock      random   –                0/4    0 %       0 to 49 %       –        – 
     drawer-close   cpn      trained          1/3   33 %       6 to 79 %      30        1 
     drawer-close   random   –                1/4   25 %       5 to 70 %      30        – 
    ──────────────────────────────────────────────────────────────────────────────────────
    drawer-close, cpn: 1 error: worker w0: step: expected <an answer>, got none
    ");
    assert_eq!(summary.errors(), 1);
}

#[test]
fn records_of_another_checkpoint_or_beyond_the_last_seed_do_not_count() {
    let (root, folder) = folder();
    let before = evaluator::report(root.path()).unwrap();
    folder.write_trial(&trial("door-lock", &run().models[0], 15, Outcome::Failure, 150)).unwrap();
    assert_eq!(evaluator::report(root.path()).unwrap(), before);

    folder.write_trial(&trial("door-lock", &model("cpn", "f", &[]), 11, Outcome::Failure, 150)).unwrap();
    let row = &evaluator::report(root.path()).unwrap().rows[0];
    assert_eq!((row.successes, row.trials), (2, 3));
}

#[test]
fn an_ablation_of_the_goal_says_so_and_counts_no_other_trials() {
    let (root, folder) = folder();
    folder.write_run(&Run { goal: GoalSource::OtherVariation, ..run() }).unwrap();
    let own = trial("door-lock", &run().models[0], 10, Outcome::Success, 40);
    folder.write_trial(&Trial { goal: GoalSource::OtherVariation, ..own }).unwrap();
    let summary = evaluator::report(root.path()).unwrap();
    assert_eq!(summary.rows.iter().map(|row| row.trials).collect::<Vec<_>>(), [1, 0, 0, 0]);
    assert!(evaluator::table(&summary).ends_with("ablation: the goal shows the end of another variation"));
    let html = std::fs::read_to_string(folder.path("report.html")).unwrap();
    assert!(html.contains("Ablation: the picture shows the end of another variation"));
}

#[test]
fn the_page_needs_nothing_else_and_escapes_what_it_shows() {
    let (root, folder) = folder();
    evaluator::report(root.path()).unwrap();
    let html = std::fs::read_to_string(folder.path("report.html")).unwrap();
    for part in [
        "Lock &amp; drawer",
        "door-lock",
        "held out",
        "&lt;an answer&gt;",
        "10–11, 13–14",
        "First failure",
        "planner-0, planner-1",
    ] {
        assert!(html.contains(part), "{part}");
    }
    for part in ["http://", "https:&#x2f;&#x2f;", "<script", "<link", "url("] {
        assert!(!html.contains(part), "{part}");
    }
    let summary: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.path("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["rows"][0]["successes"], 3);
    assert_eq!(summary["rows"][0]["training"], "held-out");
}

#[test]
fn a_run_that_names_a_single_planner_is_read() {
    let (root, folder) = folder();
    let path = folder.path("run.json");
    let mut run: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    run.as_object_mut().unwrap().remove("planners").unwrap();
    run["planner"] = "planner".into();
    std::fs::write(&path, run.to_string()).unwrap();
    assert_eq!(evaluator::report(root.path()).unwrap().run.planners, ["planner"]);
}

#[test]
fn a_record_of_another_format_is_refused() {
    let (root, folder) = folder();
    let trial = trial("door-lock", &run().models[0], 11, Outcome::Success, 50);
    folder.write_trial(&Trial { format: FORMAT + 1, ..trial }).unwrap();
    let error = evaluator::report(root.path()).unwrap_err().to_string();
    assert!(error.ends_with("door-lock/cpn/11.json: expected format 2, got 3"), "{error}");
}
