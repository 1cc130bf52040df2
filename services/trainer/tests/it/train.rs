//! Training runs on a few small episodes.

use crate::common::{SPEC, episode, info, keep, steps};
use cpn::engine::OuterLoss;
use cpn::method::Observed;
use cpn::recipe::GoalSampling;
use cpn::{Input, Losses, Method, ModelConfig, Planner, Precision, Preset, Recipe, Training, checkpoint};
use recording::Episode;
use std::path::Path;
use trainer::training::config::Config;
use trainer::training::dataset::Dataset;
use trainer::training::progress::{Observer, Progress, StopIf};
use trainer::training::run::{self, Outcome};
use trainer::training::sampler::Sampler;
use wire::Image;

fn config(folder: &Path, name: &str) -> Config {
    let dataset = folder.join("data");
    if !dataset.exists() {
        for (task, seed, steps) in [("reach", 1, 9), ("reach", 2, 7), ("door-lock", 1, 8)] {
            keep(&dataset, &episode(task, seed, steps));
        }
    }
    let out = folder.join(format!("{name}.safetensors"));
    Config { dataset, out, seed: 4, ..quick(Preset::Cpn.into(), 2, 6) }
}

/// Short training settings: epochs and batch size are given.
fn quick(config: Config, epochs: u32, batch_size: usize) -> Config {
    let training = Training { epochs, batch_size, samples_per_draw: 3, ..config.training.clone() };
    Config { training, ..config }
}

fn finished(config: &Config) -> String {
    match run::run(config, &mut StopIf(|_| false)).unwrap() {
        Outcome::Finished { digest } => digest,
        Outcome::Interrupted { step } => panic!("interrupted at {step}"),
    }
}

#[test]
fn an_interrupted_run_ends_with_the_same_weights() {
    let folder = tempfile::tempdir().unwrap();
    let whole = finished(&config(folder.path(), "whole"));
    let broken = config(folder.path(), "broken");
    for stop_at in [0, 2, 5] {
        assert_eq!(
            run::run(&broken, &mut StopIf(|step| step == stop_at)).unwrap(),
            Outcome::Interrupted { step: stop_at }
        );
        assert!(!broken.out.exists(), "no checkpoint before the end");
    }
    assert_eq!(finished(&broken), whole);
    assert!(!broken.out.with_extension("resume").exists());
}

/// Observer that collects the progress, and interrupts the run after `until` steps.
struct Notes {
    began: Vec<u64>,
    noted: Vec<Progress>,
    until: u64,
}

impl Observer for Notes {
    fn begin(&mut self, step: u64) -> anyhow::Result<()> {
        self.began.push(step);
        Ok(())
    }

    fn should_stop(&self, step: u64) -> bool {
        step == self.until
    }

    fn observe(&mut self, progress: &Progress) -> anyhow::Result<()> {
        self.noted.push(*progress);
        Ok(())
    }
}

/// The progress of an interrupted and resumed run equals that of an uninterrupted one.
#[test]
fn progress_continues_after_an_interruption() {
    let folder = tempfile::tempdir().unwrap();
    let mut whole = Notes { began: Vec::new(), noted: Vec::new(), until: u64::MAX };
    run::run(&config(folder.path(), "whole"), &mut whole).unwrap();
    let mut broken = Notes { began: Vec::new(), noted: Vec::new(), until: 5 };
    let config = config(folder.path(), "broken");
    run::run(&config, &mut broken).unwrap();
    broken.until = u64::MAX;
    run::run(&config, &mut broken).unwrap();
    assert_eq!((whole.began, broken.began), (vec![0], vec![0, 5]));

    let timeless = |noted: Vec<Progress>| -> Vec<Progress> {
        noted.into_iter().map(|progress| Progress { samples_per_second: 0.0, ..progress }).collect()
    };
    let (whole, broken) = (timeless(whole.noted), timeless(broken.noted));
    assert_eq!(whole, broken);
    // Two epochs of 21 samples in batches of 6.
    assert_eq!(whole.iter().map(|progress| progress.samples).collect::<Vec<_>>(), [6, 12, 18, 21, 27, 33, 39, 42]);
    assert_eq!(whole.iter().map(|progress| progress.epoch).collect::<Vec<_>>(), [0, 0, 0, 1, 1, 1, 1, 2]);
    assert!(whole.iter().all(|progress| progress.gradient_norm > 0.0 && progress.learning_rate > 0.0));
    assert!(whole.windows(2).all(|pair| pair[0].loss != pair[1].loss));
}

#[test]
fn a_saved_state_of_another_run_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let first = config(folder.path(), "same");
    run::run(&first, &mut StopIf(|step| step == 1)).unwrap();
    let error = run::run(&Config { seed: 5, ..first }, &mut StopIf(|_| false)).unwrap_err();
    assert!(format!("{error:#}").contains("expected the state of this run"), "{error:#}");
}

#[test]
fn a_checkpoint_has_its_provenance() {
    let folder = tempfile::tempdir().unwrap();
    let presets = [
        Preset::PaperBc,
        Preset::PaperTeBc,
        Preset::PaperTeBcHorizon,
        Preset::PaperUpn,
        Preset::Cpn,
        Preset::CpnPosition,
    ];
    for preset in presets {
        let Recipe { model, training: Training { losses, .. } } = preset.recipe();
        let config = config(folder.path(), preset.name());
        let training = Training { losses, ..config.training };
        let config = Config { model, training, hold_out: vec!["door-lock".into()], ..config };
        let digest = finished(&config);
        let loaded = checkpoint::from_bytes(&std::fs::read(&config.out).unwrap()).unwrap();
        assert_eq!(loaded.digest, digest);
        // At most one goal of each episode is stored.
        let familiar_goals = config.model.familiar_goals.min(2);
        assert_eq!(loaded.model.config, ModelConfig { familiar_goals, ..config.model });
        assert_eq!(loaded.provenance.training_tasks, ["reach"]);
        assert_eq!((loaded.provenance.seed, &loaded.provenance.training), (4, &config.training));
        assert_eq!(loaded.provenance.data_digest.len(), 64);
        assert_eq!(loaded.provenance.render_spec, SPEC);
    }
}

/// Demonstration whose last frame is one of similar goals: an image with a few rows of its own.
fn with_similar_goal(seed: u64) -> Episode {
    let mut steps = steps("reach", seed, 5);
    let shared = episode("goal", 1, 2).steps()[1].frame.clone();
    let own = steps[4].frame.data()[..2 * 3 * shared.width() as usize].to_vec();
    let data = [&own, &shared.data()[own.len()..]].concat();
    steps[4].frame = Image::new(shared.height(), shared.width(), data).unwrap().rendered_as(SPEC).unwrap();
    Episode::new(info("reach", seed, &steps), steps).unwrap()
}

#[test]
fn a_trained_model_recognises_the_goals_of_its_episodes() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = folder.path().join("data");
    (0..6).for_each(|seed| keep(&dataset, &with_similar_goal(seed)));
    let config = quick(Config { dataset, ..Preset::CpnPosition.into() }, 1, 6);
    let model = ModelConfig { familiar_goals: 4, ..config.model };
    let config = Config { out: folder.path().join("x.safetensors"), model, ..config };
    finished(&config);

    let model = checkpoint::from_bytes(&std::fs::read(&config.out).unwrap()).unwrap().model;
    assert_eq!(model.config.familiar_goals, 4);
    let mut planner = Planner::new(&model, Precision::Float32, 1);
    let mut is_familiar = |frame: &Image| {
        let x_g = planner.encode(&[Observed::Image(frame.data())]).remove(0);
        planner.is_familiar(&x_g)
    };
    for seed in 0..6 {
        let episode = with_similar_goal(seed);
        assert!(is_familiar(&episode.steps()[4].frame), "the goal of episode {seed}");
        assert!(!is_familiar(&episode.steps()[3].frame), "a random image");
    }
}

/// A preset round-trips through TOML, and a file, arguments and changes override it.
#[test]
fn settings_are_layered_over_a_preset() {
    for preset in Preset::ALL {
        let printed = toml::to_string(&Config::from(preset)).unwrap();
        assert_eq!(Config::from_toml(&printed).unwrap(), Config::from(preset));
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("settings.toml");
    std::fs::write(&file, "preset = \"paper-upn\"\ntraining.epochs = 7\nmodel.updates = 3\n").unwrap();
    let typed = serde_json::json!({"seed": 9});
    let load = |changes: &[&str]| {
        Config::load(Some(&file), &typed, &changes.iter().map(|c| c.to_string()).collect::<Vec<_>>())
    };
    let config = load(&["training.goals=hindsight", "model.encoder.latent=32"]).unwrap();
    assert_eq!((config.preset, config.seed, config.training.epochs), (Preset::PaperUpn, 9, 7));
    assert_eq!((config.model.updates, config.model.encoder.latent()), (3, 32));
    assert_eq!(config.training.goals, GoalSampling::Hindsight);

    assert_eq!(load(&["dataset=2024"]).unwrap().dataset, Path::new("2024"));
    for text in ["1e-3", "0.001"] {
        let rate = load(&[&format!("training.peak_learning_rate={text}")]).unwrap().training.peak_learning_rate;
        assert_eq!(rate, 1e-3, "{text}");
    }

    let refused = |change: &str| format!("{:#}", load(&[change]).unwrap_err());
    assert!(refused("training.epoch=7").contains("unknown field"), "{}", refused("training.epoch=7"));
    assert_eq!(refused("training.batch_size=0"), "training.batch_size: expected 1 to 65536, got 0");
    assert_eq!(refused("epochs"), "expected key=value, got \"epochs\"");
    assert!(refused("preset=fast").contains("unknown variant"), "{}", refused("preset=fast"));
}

/// Few random samples can be overfitted: the loss must fall far below that of a nearly untrained policy.
#[test]
fn training_lowers_the_loss() {
    let folder = tempfile::tempdir().unwrap();
    let base = config(folder.path(), "short");
    let loss_of = |path: &Path| {
        let model = checkpoint::from_bytes(&std::fs::read(path).unwrap()).unwrap().model;
        let dataset = Dataset::load(&base.dataset, &[], Input::Image).unwrap();
        let recipe = base.recipe();
        let sampler = Sampler::new(&dataset, &recipe, 0);
        let batch = sampler.batch(0, &sampler.epoch(0));
        OuterLoss::new(&model.config, Losses::default(), Precision::Float32, 1)
            .differentiate(&model.weights, &batch)
            .loss
    };
    finished(&quick(base.clone(), 1, 50));
    let before = loss_of(&base.out);
    let long = Config { out: folder.path().join("long.safetensors"), ..quick(base.clone(), 40, 6) };
    finished(&long);
    let after = loss_of(&long.out);
    assert!(after < 0.5 * before, "{before} before, {after} after");
}

#[test]
fn bad_input_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let good = config(folder.path(), "x");
    let refused = |config: &Config| format!("{:#}", run::run(config, &mut StopIf(|_| false)).unwrap_err());

    let message = refused(&Config { hold_out: vec!["door-lokc".into()], ..good.clone() });
    assert!(message.contains("hold_out: expected some of [\"door-lock\", \"reach\"], got \"door-lokc\""), "{message}");
    let message = refused(&Config { dataset: folder.path().join("nowhere"), ..good.clone() });
    assert!(message.contains("nowhere"), "{message}");
    let message = refused(&quick(good.clone(), 1, 0));
    assert!(message.contains("batch_size"), "{message}");
    let model = ModelConfig { actions: 3, ..good.model.clone() };
    let message = refused(&Config { model, ..good.clone() });
    assert_eq!(message, "model.actions: expected 4 as the demonstrations have, got 3");

    let mut others = steps("reach", 3, 4);
    for step in &mut others {
        step.frame = step.frame.clone().rendered_as("other").unwrap();
    }
    let other = Episode::new(info("reach", 3, &others), others).unwrap();
    let path = good.dataset.join("reach/reach-3.mcap");
    std::fs::write(&path, recording::to_bytes(&other).unwrap()).unwrap();
    let message = refused(&good);
    let mixed = format!("render_spec: expected {SPEC:?} like the episodes before, got \"other\"");
    assert!(message.contains("reach-3.mcap") && message.contains(&mixed), "{message}");
    std::fs::remove_file(path).unwrap();

    let path = good.dataset.join("reach/reach-1.mcap");
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let message = refused(&good);
    assert!(message.contains("reach-1.mcap") && message.contains("recording:"), "{message}");
    assert!(!good.out.exists());
}

#[test]
fn settings_are_checked_before_files_are_read() {
    let load = |change: &str| Config::load(None, &serde_json::json!({"dataset": "nowhere"}), &[change.to_owned()]);
    for (change, reason) in [
        ("threads=0", "threads: expected 1 to 1024, got 0"),
        ("threads=100000", "threads: expected 1 to 1024, got 100000"),
        ("save_interval_seconds=-1.0", "save_interval_seconds: expected a number of seconds from 0 on, got -1.0"),
        ("out=models/..", "out: expected the path of a file, got \"models/..\""),
        ("hold_out=[\"reach\", \"\"]", "hold_out: expected tasks, each once, got [\"reach\", \"\"]"),
        ("hold_out=[\"reach\", \"reach\"]", "hold_out: expected tasks, each once, got [\"reach\", \"reach\"]"),
        (
            "model.position_dynamics=true",
            "training.losses.dynamics: expected above 0 (with position_dynamics) to 1000000, got 0",
        ),
    ] {
        assert_eq!(format!("{:#}", load(change).unwrap_err()), reason);
    }
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path(), "x");
    finished(&Config { threads: 1024, ..config.clone() });
    let config = Config { out: folder.path().join("folder"), ..config };
    std::fs::create_dir(&config.out).unwrap();
    let error = format!("{:#}", run::run(&config, &mut StopIf(|_| false)).unwrap_err());
    assert!(error.starts_with("out: expected the path of a file, got that of a folder"), "{error}");
}

#[test]
fn a_checkpoint_is_written_by_one_process() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path(), "x");
    let keeper = service_kit::files::take_over_file(&config.out).unwrap();
    let error = format!("{:#}", run::run(&config, &mut StopIf(|_| false)).unwrap_err());
    let expected = format!("out: {}: expected one that no process keeps, got that of process ", config.out.display());
    assert!(error.starts_with(&expected), "{error}");
    drop(keeper);
    finished(&config);
}

/// Two runs whose checkpoints have the same name in different folders do not share a journal.
#[test]
fn a_curve_is_not_overwritten_by_another_run() {
    let folder = tempfile::tempdir().unwrap();
    config(folder.path(), "data");
    let run = |out: &str| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_cpn-trainer"));
        command.args(["train", "--preset", "paper-bc", "--dataset", "data", "--out", out]);
        command.args(["--set", "training.epochs=1", "--set", "training.batch_size=12"]);
        let output = command.current_dir(folder.path()).output().unwrap();
        (output.status.success(), String::from_utf8(output.stderr).unwrap())
    };
    let curve = || std::fs::read(folder.path().join("runs/training/x/progress.jsonl")).unwrap();
    assert!(run("a/x.safetensors").0);
    let before = curve();
    let (success, said) = run("b/x.safetensors");
    assert!(!success && said.contains("run_dir: expected a folder of ") && said.contains("a/x.safetensors"), "{said}");
    assert!(curve() == before && !folder.path().join("b").exists());
    // The same run may use the folder again, and the other once the files of the first are removed.
    assert!(run("a/x.safetensors").0);
    assert_ne!(curve(), before);
    std::fs::remove_dir_all(folder.path().join("a")).unwrap();
    assert!(run("b/x.safetensors").0);
}
