//! The report is made from the records alone.

use evaluator::{Episode, FORMAT, Folder, GoalSource, Model, Outcome, Planning, Run, StageTimes, Trial};
use recording::trial::{Frame, Recording};
use std::time::Duration;
use wire::Image;
use wire::sim::Variation;
use wire::trial::RecordedTrial;

/// Seeds below are those of demonstrations.
const FIRST_SEED: u64 = 1_000_000;

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
        first_seed: FIRST_SEED + 10,
        goal: GoalSource::SameVariation,
        planning: Planning::default(),
    }
}

fn trial(task: &str, model: &Model, seed: u64, outcome: Outcome, steps: u32) -> Trial {
    let episode = Episode {
        goal_id: "c".repeat(64),
        steps,
        progress: [0.0, 0.5, 0.25].into(),
        plan_steps: vec![],
        latent_distances: vec![Some(1.5); steps as usize],
        first_inner_losses: vec![Some(2.0), None],
        last_inner_losses: vec![],
        mean_times: StageTimes::default(),
    };
    let (task, model, model_digest) = (task.into(), model.name.clone(), model.digest.clone());
    let (seed, goal, planning) = (FIRST_SEED + seed, GoalSource::SameVariation, Planning::default());
    Trial { format: FORMAT, task, seed, model, model_digest, goal, planning, outcome, episode: Some(episode) }
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
    ──────────────────────────────────────────────────────────────────────────────────────────────────
     task           model    task was   successes   rate   95 % interval   steps    progress   errors 
    ══════════════════════════════════════════════════════════════════════════════════════════════════
     door-lock      cpn      held out         3/4   75 %      30 to 95 %      50   0.50 0.25        – 
     door-lock      random   –                0/4    0 %       0 to 49 %       –   0.50 0.25        – 
     drawer-close   cpn      trained          1/3   33 %       6 to 79 %      30   0.50 0.25        1 
     drawer-close   random   –                1/4   25 %       5 to 70 %      30   0.50 0.25        – 
    ──────────────────────────────────────────────────────────────────────────────────────────────────
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

/// A trial whose task was solved before any action is in no rate, and every list of seeds is told by its digest.
#[test]
fn what_was_solved_at_reset_is_counted_apart() {
    let (root, folder) = folder();
    let before = evaluator::report(root.path()).unwrap();
    let solved = trial("door-lock", &run().models[0], 14, Outcome::SolvedAtReset, 0);
    folder.write_trial(&Trial { episode: None, ..solved }).unwrap();
    let summary = evaluator::report(root.path()).unwrap();
    let row = &summary.rows[0];
    assert_eq!((row.successes, row.trials, row.solved_at_reset, row.rate), (3, 3, 1, Some(1.0)));
    assert_eq!(summary.seeds_digest, before.seeds_digest, "they are the same variations");
    let line = "door-lock, cpn: 1 solved at reset, which are no attempts and not counted";
    assert!(evaluator::table(&summary).contains(line), "{}", evaluator::table(&summary));
    let text = |name: &str| std::fs::read_to_string(folder.path(name)).unwrap();
    assert!(text("trials/door-lock/cpn/1000014.json").contains("\"outcome\": \"solved-at-reset\""));
    assert!(text("report.html").contains("1 trial was no attempt"));
    assert!(text("report.html").contains(&summary.seeds_digest));
    assert_eq!(summary.seeds["door-lock"].iter().collect::<Vec<_>>(), [&1_000_010, &1_000_011, &1_000_013, &1_000_014]);
    folder.write_run(&Run { trials: 3, ..run() }).unwrap();
    assert_ne!(evaluator::report(root.path()).unwrap().seeds_digest, summary.seeds_digest);
}

/// Filmstrips come from the recordings of the first success and failure; where none can be read, the report does without.
#[test]
fn filmstrips_are_frames_of_the_recordings() {
    let (root, folder) = folder();
    let pictures = || {
        evaluator::report(root.path()).unwrap();
        let html = std::fs::read_to_string(folder.path("report.html")).unwrap();
        let last_frames = [40, 50, 150].map(|steps| html.contains(&format!("alt=\"After {steps} steps\"")));
        (html.matches("data:image/png;base64,").count(), last_frames)
    };
    assert_eq!(pictures(), (0, [false; 3]));

    for (seed, steps) in [(10, 40), (11, 50), (14, 150)] {
        folder.write_recording(&recording(seed, steps)).unwrap();
    }
    assert_eq!(pictures(), (2 * 9, [true, false, true]));

    std::fs::write(folder.path("trials/door-lock/cpn/1000010.mcap"), "of another version").unwrap();
    assert_eq!(pictures(), (9, [false, false, true]));
}

/// Recording of a trial of door-lock.
fn recording(seed: u64, steps: u32) -> Recording {
    let image = |shade: u32| Image::new(2, 2, vec![shade as u8; 12]).unwrap();
    let model = &run().models[0];
    let trial = RecordedTrial {
        variation: Variation { task: "door-lock".into(), seed: FIRST_SEED + seed },
        model: model.name.clone(),
        model_digest: model.digest.clone(),
        goal: image(255),
        goal_position: None,
        steps,
        plans: 0,
    };
    let frame = |step| Frame { image: image(step), time: Duration::from_millis(step.into()) };
    Recording::new(trial, (0..=steps).map(frame).collect(), Vec::new()).unwrap()
}

/// Records without progress are read; those without settings are from before there were approaches.
#[test]
fn records_without_settings_and_progress_are_read() {
    let (root, folder) = folder();
    let path = folder.path("trials/door-lock/cpn/1000010.json");
    let mut record: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    record["episode"].as_object_mut().unwrap().remove("progress").unwrap();
    std::fs::write(&path, record.to_string()).unwrap();
    let row = &evaluator::report(root.path()).unwrap().rows[0];
    assert_eq!((row.trials, row.mean_best_progress, row.mean_final_progress), (4, Some(0.5), Some(0.25)));

    for name in ["run.json", "trials/door-lock/cpn/1000010.json"] {
        let mut record: serde_json::Value = serde_json::from_slice(&std::fs::read(folder.path(name)).unwrap()).unwrap();
        record.as_object_mut().unwrap().remove("planning").unwrap();
        std::fs::write(folder.path(name), record.to_string()).unwrap();
    }
    let summary = evaluator::report(root.path()).unwrap();
    assert_eq!((summary.run.planning.no_approaches, summary.rows[0].trials), (true, 1));
    folder.write_run(&run()).unwrap();
    assert_eq!(evaluator::report(root.path()).unwrap().rows[0].trials, 3);

    // Trials with other settings of plans belong to another run.
    let planning = Planning { updates: Some(20), ..Planning::default() };
    let other = trial("door-lock", &run().models[0], 10, Outcome::Success, 40);
    folder.write_trial(&Trial { planning, ..other }).unwrap();
    assert_eq!(evaluator::report(root.path()).unwrap().rows[0].trials, 3);
    folder.write_run(&Run { planning, ..run() }).unwrap();
    let summary = evaluator::report(root.path()).unwrap();
    assert_eq!(summary.rows.iter().map(|row| row.trials).collect::<Vec<_>>(), [1, 0, 0, 0]);
    assert!(evaluator::table(&summary).contains("plans: --updates 20"));
}

#[test]
fn seeds_of_demonstrations_are_marked() {
    let (root, folder) = folder();
    let mark = "not an evaluation: the seeds are those of demonstrations";
    let summary = evaluator::report(root.path()).unwrap();
    assert!(!summary.demonstration_seeds && !evaluator::table(&summary).contains(mark));
    folder.write_run(&Run { first_seed: FIRST_SEED - 1, ..run() }).unwrap();
    let summary = evaluator::report(root.path()).unwrap();
    assert!(evaluator::table(&summary).contains(mark));
    let text = |name: &str| std::fs::read_to_string(folder.path(name)).unwrap();
    assert!(text("report.html").contains("Not an evaluation: the seeds are those of demonstrations"));
    assert!(text("summary.json").contains("\"demonstration_seeds\": true"));
}

/// A record counts where it says that it belongs, and one that is damaged stops nobody.
#[test]
fn misplaced_and_damaged_records_are_left_out() {
    let (root, folder) = folder();
    let rows = |rows: &[evaluator::Row]| rows.iter().map(|row| (row.successes, row.trials)).collect::<Vec<_>>();
    assert_eq!(rows(&evaluator::report(root.path()).unwrap().rows), [(3, 4), (0, 4), (1, 3), (1, 4)]);
    let path = |place: &str| folder.path("trials").join(place);
    let success = std::fs::read(path("door-lock/cpn/1000010.json")).unwrap();
    for place in ["door-lock/cpn/1000014.json", "door-lock/random/1000010.json", "drawer-close/cpn/1000011.json"] {
        std::fs::write(path(place), &success).unwrap();
    }
    std::fs::write(path("drawer-close/random/1000012.json"), "").unwrap();
    std::fs::write(path("drawer-close/random/1000013.json"), &success[..success.len() / 2]).unwrap();
    std::fs::write(path("drawer-close/random/._1000013.json"), "AppleDouble").unwrap();
    assert_eq!(rows(&evaluator::report(root.path()).unwrap().rows), [(3, 3), (0, 3), (1, 2), (1, 2)]);

    std::fs::write(folder.path("run.json"), "").unwrap();
    let error = format!("{:#}", evaluator::report(root.path()).unwrap_err());
    assert!(error.starts_with("remove the file if it is damaged") && error.contains("run.json"), "{error}");
}

fn command(arguments: &[&str], out: &std::path::Path) -> std::process::Command {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_cpn-eval"));
    command.args(arguments).arg("--out").arg(out);
    command
}

#[test]
fn a_closed_output_ends_quietly_and_a_full_disk_is_named() {
    let (root, folder) = folder();
    folder.write_trial(&trial("drawer-close", &run().models[0], 13, Outcome::Success, 30)).unwrap();
    let full = || std::fs::File::options().write(true).open("/dev/full").unwrap();
    for arguments in [&["report"][..], &["report", "--json"]] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = command(arguments, root.path()).stdout(writer).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        let output = command(arguments, root.path()).stdout(full()).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(1) && said.contains("Error: standard output /dev/full"), "{said}");
        let output = command(arguments, root.path()).stderr(full()).output().unwrap();
        assert!(output.status.success() && !output.stdout.is_empty(), "a log that cannot be written is no error");
    }
}

#[test]
fn a_folder_has_one_run_at_a_time() {
    let root = tempfile::tempdir().unwrap();
    let keeper = service_kit::files::take_over(root.path()).unwrap();
    let run = || {
        let output = command(&["run", "--tasks", "reach", "--wait-secs", "1"], root.path()).output().unwrap();
        assert!(!output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    let said = run();
    let expected = format!("expected one that no process keeps, got that of process {} (", std::process::id());
    assert!(said.contains("--out") && said.contains(&expected), "{said}");
    drop(keeper);
    assert!(run().contains("still without planner"));
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
        "1000010–1000011, 1000013–1000014",
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
    assert!(error.ends_with("door-lock/cpn/1000011.json: expected format 2, got 3"), "{error}");
}
