//! Comparisons are made from the records alone.

use evaluator::{Comparison, Counts, Episode, FORMAT, Folder, GoalSource, Model, Outcome, Planning, Run, Source};
use evaluator::{StageTimes, Trial};
use std::path::Path;

const FIRST_SEED: u64 = 1_000_000;

fn model(name: &str) -> Model {
    let (method, digest) = (name.into(), "a".repeat(64));
    Model { name: name.into(), method, digest, training_tasks: vec![], horizon: 5 }
}

fn run(models: &[&str], tasks: &[&str]) -> Run {
    Run {
        format: FORMAT,
        title: String::new(),
        command: String::new(),
        date: String::new(),
        planners: vec!["planner".into()],
        models: models.iter().copied().map(model).collect(),
        tasks: tasks.iter().map(ToString::to_string).collect(),
        trials: 20,
        first_seed: FIRST_SEED,
        goal: GoalSource::SameVariation,
        planning: Planning::default(),
    }
}

fn trial(run: &Run, task: &str, model: &Model, seed: u64, outcome: Outcome) -> Trial {
    let episode = Episode {
        goal_id: format!("{task} {seed}"),
        steps: if outcome == Outcome::Success { 40 } else { 150 },
        progress: vec![],
        plan_steps: vec![],
        latent_distances: vec![],
        first_inner_losses: vec![],
        last_inner_losses: vec![],
        mean_times: StageTimes::default(),
    };
    Trial {
        format: FORMAT,
        task: task.into(),
        seed: FIRST_SEED + seed,
        model: model.name.clone(),
        model_digest: model.digest.clone(),
        goal: run.goal,
        planning: run.planning,
        outcome,
        episode: Some(episode),
    }
}

/// The folder of a run in which each model solves the seeds that `solves` says, of 20 of each task.
fn evaluation(root: &Path, name: &str, run: &Run, solves: impl Fn(&str, &str, u64) -> bool) -> Source {
    let folder = Folder::new(root.join(name));
    folder.write_run(run).unwrap();
    for (task, model) in run.tasks.iter().flat_map(|task| run.models.iter().map(move |model| (task, model))) {
        for seed in 0..20 {
            let outcome = if solves(task, &model.name, seed) { Outcome::Success } else { Outcome::Failure };
            folder.write_trial(&trial(run, task, model, seed, outcome)).unwrap();
        }
    }
    root.join(name).to_str().unwrap().parse().unwrap()
}

fn of(source: &Source, model: &str) -> Source {
    format!("{source}:{model}").parse().unwrap()
}

fn compare(a: &[Source], b: &[Source]) -> Comparison {
    evaluator::compare(a, b).unwrap()
}

fn refusal(a: &Source, b: &Source) -> String {
    format!("{:#}", evaluator::compare(std::slice::from_ref(a), std::slice::from_ref(b)).unwrap_err())
}

/// Nine seeds of reach are solved by cpn only, one by bc only, and three by both; of door-lock none by anyone.
fn cpn_and_bc(task: &str, model: &str, seed: u64) -> bool {
    task == "reach" && matches!((model, seed), (_, 0..3) | ("cpn", 3..12) | ("bc", 12))
}

#[test]
fn two_models_of_a_folder_are_compared_seed_by_seed() {
    let root = tempfile::tempdir().unwrap();
    let source = evaluation(root.path(), "run", &run(&["cpn", "bc"], &["reach", "door-lock"]), cpn_and_bc);
    let comparison = compare(&[of(&source, "cpn")], &[of(&source, "bc")]);
    let [door_lock, reach] = comparison.tasks.as_slice() else { panic!("{comparison:?}") };
    assert_eq!((reach.task.as_str(), reach.variations, reach.rates), ("reach", 20, (0.6, 0.2)));
    assert_eq!(reach.counts, Some(Counts { both: 3, a_only: 9, b_only: 1, neither: 7 }));
    assert!((reach.p.unwrap() - 0.021484375).abs() < 1e-12);
    assert!((reach.difference - 0.4).abs() < 1e-12 && reach.interval.0 > 0.0 && reach.interval.1 < 0.7);
    assert_eq!((door_lock.p, door_lock.difference), (Some(1.0), 0.0));
    assert!((comparison.difference - 0.2).abs() < 1e-12);
    assert!(comparison.interval.0 > 0.0 && comparison.interval.1 < 0.4, "{:?}", comparison.interval);

    let table = evaluator::comparison_table(&comparison);
    let row = |start: &str| table.lines().find(|line| line.trim().starts_with(start)).unwrap().to_owned();
    let cells: Vec<_> = row("reach").split_whitespace().map(str::to_owned).collect();
    assert_eq!(cells[..8], ["reach", "60", "%", "20", "%", "9", "1", "0.021"]);
    assert!(row("reach").trim().ends_with("yes") && row("door-lock").trim().ends_with("no"));
    assert!(table.contains(&comparison.seeds_digest) && table.contains("run:cpn"));

    // The other way round, all signs change.
    let swapped = compare(&[of(&source, "bc")], &[of(&source, "cpn")]);
    let (there, back) = (reach.interval, swapped.tasks[1].interval);
    assert!((there.0 + back.1).abs() < 1e-9 && (there.1 + back.0).abs() < 1e-9);
}

#[test]
fn trials_without_a_result_leave_their_variation_out_on_both_sides() {
    let root = tempfile::tempdir().unwrap();
    let run = run(&["cpn", "bc"], &["reach"]);
    let source = evaluation(root.path(), "run", &run, cpn_and_bc);
    let folder = Folder::new(&source.folder);
    let write = |model: &Model, seed, outcome| {
        folder.write_trial(&Trial { episode: None, ..trial(&run, "reach", model, seed, outcome) }).unwrap();
    };
    write(&run.models[0], 3, Outcome::Error { message: "worker w0".into() });
    write(&run.models[0], 12, Outcome::SolvedAtReset);
    write(&run.models[1], 12, Outcome::SolvedAtReset);
    let reach = &compare(&[of(&source, "cpn")], &[of(&source, "bc")]).tasks[0];
    assert_eq!((reach.variations, reach.errors, reach.solved_at_reset), (18, 1, 1));
    assert_eq!(reach.counts, Some(Counts { both: 3, a_only: 8, b_only: 0, neither: 7 }));
}

/// Five discordant pairs in one direction are fair coins in 6 of 100 cases.
#[test]
fn few_pairs_tell_nothing_apart() {
    let root = tempfile::tempdir().unwrap();
    let solves = |_: &str, model: &str, seed| model == "cpn" && seed < 5;
    let source = evaluation(root.path(), "run", &run(&["cpn", "bc"], &["reach"]), solves);
    let comparison = compare(&[of(&source, "cpn")], &[of(&source, "bc")]);
    let reach = &comparison.tasks[0];
    assert!((reach.p.unwrap() - 0.0625).abs() < 1e-12, "{reach:?}");
    assert!(reach.interval.0 > 0.0 && !reach.told_apart, "{reach:?}");
    assert!(!comparison.told_apart);
}

/// Folders of other tasks are joined; those of the same tasks are training runs, whose differences widen the interval.
#[test]
fn folders_of_an_arm_are_tasks_and_training_runs() {
    let root = tempfile::tempdir().unwrap();
    let folder = |name: &str, model: &str, task: &str, solved: u64| {
        evaluation(root.path(), name, &run(&[model], &[task]), |_, _, seed| seed < solved)
    };
    let bc = [folder("bc-reach", "bc", "reach", 0), folder("bc-lock", "bc", "door-lock", 0)];
    let one = [folder("cpn-reach", "cpn", "reach", 10), folder("cpn-lock", "cpn", "door-lock", 10)];
    let single = compare(&one, &bc);
    assert_eq!((single.tasks.len(), single.difference), (2, 0.5));
    assert!(single.p.unwrap() < 1e-4);

    let two = [folder("cpn-reach-0", "cpn", "reach", 0), folder("cpn-reach-1", "cpn", "reach", 20)];
    let several = compare(&[&two[..], &one[1..]].concat(), &bc);
    assert_eq!((several.difference, several.p, several.counts), (0.5, None, None));
    assert_eq!(several.tasks[1].runs, (2, 1));
    assert_eq!((several.tasks[1].interval, several.tasks[1].p), ((0.0, 1.0), None));
    let width = |comparison: &Comparison| comparison.interval.1 - comparison.interval.0;
    assert!(width(&several) > 2.0 * width(&single), "{:?}, {:?}", several.interval, single.interval);

    let both = evaluation(root.path(), "cpn-both", &run(&["cpn"], &["door-lock", "reach"]), cpn_and_bc);
    let error = format!("{:#}", evaluator::compare(&[one[0].clone(), both], &bc).unwrap_err());
    assert!(error.contains("A: expected folders of the same tasks or of no task in common, got "), "{error}");
}

#[test]
fn what_was_not_evaluated_alike_is_refused_by_name() {
    let root = tempfile::tempdir().unwrap();
    let base = run(&["cpn"], &["reach"]);
    let folder = |name: &str, run: &Run| evaluation(root.path(), name, run, cpn_and_bc);
    let expected = folder("expected", &base);
    let planned = |planning| Run { planning, ..base.clone() };
    let default = Planning::default();

    // Another search is what may be compared.
    let updates = folder("updates", &planned(Planning { updates: Some(20), ..default }));
    assert_eq!(compare(std::slice::from_ref(&expected), &[updates]).difference, 0.0);

    let cases = [
        ("goal", Run { goal: GoalSource::OtherVariation, ..base.clone() }, "goals (--goal): expected the same, got "),
        ("repeat", planned(Planning { apply_actions: 2, ..default }), "applied actions of a plan (--apply-actions): "),
        ("time", planned(Planning { real_time: true, ..default }), "time of the simulation (--real-time): "),
        (
            "tasks",
            Run { tasks: vec!["door-lock".into()], ..base.clone() },
            "tasks: expected the same, got reach in A and ",
        ),
    ];
    for (name, run, refused) in cases {
        let error = refusal(&expected, &folder(name, &run));
        assert!(error.contains(refused), "{error}");
    }

    let spoiled = |name: &str, spoil: &dyn Fn(&Folder)| {
        let source = folder(name, &base);
        spoil(&Folder::new(&source.folder));
        refusal(&expected, &source)
    };
    let fewer = spoiled("fewer", &|folder| {
        std::fs::remove_file(folder.path("trials/reach/cpn/1000007.json")).unwrap();
    });
    assert!(fewer.contains("expected:cpn has seeds [1000007], only ") && fewer.ends_with("has seeds []"), "{fewer}");
    let changed = |seed, change: fn(&mut Episode)| {
        let mut trial = trial(&base, "reach", &base.models[0], seed, Outcome::Failure);
        trial.episode.iter_mut().for_each(change);
        trial
    };
    let goal = spoiled("picture", &|folder| {
        folder.write_trial(&changed(15, |episode| episode.goal_id = "another".into())).unwrap();
    });
    assert!(goal.starts_with("goal of reach 15: ") || goal.starts_with("goal of reach 1000015: "), "{goal}");
    let steps = spoiled("steps", &|folder| {
        (12..20).for_each(|seed| folder.write_trial(&changed(seed, |episode| episode.steps = 200)).unwrap());
    });
    assert!(steps.contains("steps of an episode of reach: expected the same, got 150 in "), "{steps}");

    let several = evaluation(root.path(), "several", &run(&["cpn", "bc"], &["reach"]), cpn_and_bc);
    assert!(refusal(&expected, &several).ends_with("expected FOLDER:MODEL with one of its models, cpn, bc"));
    assert!(refusal(&expected, &of(&several, "upn")).ends_with("expected one of its models, cpn, bc, got upn"));
    assert!("".parse::<Source>().is_err() && "folder:".parse::<Source>().is_err());
}

#[test]
fn the_command_prints_a_table_or_json() {
    let root = tempfile::tempdir().unwrap();
    let source = evaluation(root.path(), "run", &run(&["cpn", "bc"], &["reach"]), cpn_and_bc);
    let command = |arguments: &[&str]| {
        let (a, b) = (of(&source, "cpn").to_string(), of(&source, "bc").to_string());
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_cpn-eval"));
        let output = command.args(["compare", &a, &b]).args(arguments).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    assert!(command(&[]).contains("mean of the tasks"));
    let json: serde_json::Value = serde_json::from_str(&command(&["--json"])).unwrap();
    assert_eq!(json["tasks"][0]["counts"]["a_only"], 9);
    assert!((json["tasks"][0]["p"].as_f64().unwrap() - 0.021484375).abs() < 1e-12);
}
