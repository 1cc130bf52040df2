//! Training runs on positions.

use crate::common::{episode, info, keep, steps};
use cpn::method::{Iterations, Observed, Query, Search, Solver};
use cpn::recipe::GoalSampling;
use cpn::{Frames, Input, Method, Model, ModelConfig, Planner, Precision, Preset, Recipe, Training, checkpoint};
use recording::Episode;
use std::path::Path;
use trainer::training::config::Config;
use trainer::training::dataset::Dataset;
use trainer::training::progress::StopIf;
use trainer::training::run::{self, Outcome};
use trainer::training::sampler::Sampler;
use wire::demonstration::RecordedEpisode;

/// Goal position, 1 cm beyond the hand's final position, as a block is beyond the hand that pokes it.
const GOAL: [f32; 3] = [0.71, 0.0, 0.2];
const STARTS: [[f32; 3]; 4] = [[0.65, -0.03, 0.2], [0.63, 0.02, 0.22], [0.64, 0.0, 0.17], [0.66, 0.03, 0.19]];
const ACTIONS: u32 = 8;

/// Position of the hand at a step of a straight path, which ends 1 cm before the goal.
fn hand(start: [f32; 3], step: u32) -> [f32; 3] {
    let end = [GOAL[0] - 0.01, GOAL[1], GOAL[2]];
    [0, 1, 2].map(|axis| start[axis] + (end[axis] - start[axis]) * step as f32 / ACTIONS as f32)
}

/// Demonstration of that path; an action of 1 moves the hand by 1 cm.
fn reach(seed: u64, start: [f32; 3]) -> Episode {
    let mut steps = steps("poke", seed, ACTIONS + 1);
    for step in &mut steps {
        let (now, next) = (hand(start, step.step), hand(start, step.step + 1));
        step.state = now.to_vec();
        step.applied_action = None;
        step.action = (step.step < ACTIONS).then(|| [0, 1, 2].map(|axis| (next[axis] - now[axis]) * 100.0).to_vec());
    }
    Episode::new(RecordedEpisode { goal_position: GOAL.to_vec(), ..info("poke", seed, &steps) }, steps).unwrap()
}

fn config(folder: &Path) -> Config {
    let dataset = folder.join("data");
    if !dataset.exists() {
        STARTS.into_iter().zip(0..).for_each(|(start, seed)| keep(&dataset, &reach(seed, start)));
    }
    let config = Config::from(Preset::Jenga);
    // Short plans can be learnt from few demonstrations.
    let model = ModelConfig { horizon: 1, updates: 1, ..config.model.clone() };
    few(Config { dataset, out: folder.join("jenga.safetensors"), model, ..config })
}

/// Settings for few demonstrations.
fn few(config: Config) -> Config {
    Config { training: Training { epochs: 150, batch_size: 16, ..config.training }, ..config }
}

fn distance(hand: [f32; 3], goal: [f32; 3]) -> f32 {
    hand.iter().zip(goal).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt()
}

/// Position of the hand after [`ACTIONS`] first actions of plans with a number of updates.
fn end(model: &Model, mut hand: [f32; 3], goal: [f32; 3], updates: usize) -> [f32; 3] {
    let mut planner = Planner::new(model, Precision::Float32, 1);
    for _ in 0..ACTIONS {
        let ends = planner.encode(&[Observed::Position(hand), Observed::Position(goal)]);
        let query = Query { x: &ends[0], x_g: &ends[1], steps_left: 1, seed: 0, start: &[], keep_initial: false };
        let iterations = Iterations::Fixed(updates);
        let plans = planner.plan(&[query], &mut Search { solver: Solver::Gradient, iterations });
        hand = [0, 1, 2].map(|axis| hand[axis] + plans[0].actions[0][axis].clamp(-1.0, 1.0) / 100.0);
    }
    hand
}

#[test]
fn a_model_of_positions_learns_to_reach_a_goal() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path());
    let outcome = run::run(&config, &mut StopIf(|_| false)).unwrap();
    assert!(matches!(outcome, Outcome::Finished { .. }));
    let loaded = checkpoint::from_bytes(&std::fs::read(&config.out).unwrap()).unwrap();
    assert_eq!((&loaded.model.config, loaded.provenance.render_spec.as_str()), (&config.model, ""));
    let start = [0.64, 0.01, 0.2];
    let (before, after) = (distance(start, GOAL), distance(end(&loaded.model, start, GOAL, 1), GOAL));
    assert!(after < before / 3.0, "{after} m from the goal, {before} m at the start");
}

#[test]
fn position_dynamics_reach_goals_at_heights_without_demonstrations() {
    let folder = tempfile::tempdir().unwrap();
    let Config { dataset, out, .. } = config(folder.path());
    let config = Config { dataset, out, ..Config::from(Preset::JengaPosition) };
    // Of a plan over H steps the first goes a share of 1 / H.
    let config = few(Config { model: ModelConfig { horizon: 2, ..config.model }, ..config });
    run::run(&config, &mut StopIf(|_| false)).unwrap();
    let model = checkpoint::from_bytes(&std::fs::read(&config.out).unwrap()).unwrap().model;

    let [start, goal] = [[0.64, 0.01, 0.2], [0.69, 0.0, 0.26]];
    let [policy, planned] = [0, 5].map(|updates| distance(end(&model, start, goal, updates), goal));
    assert!(planned < 0.005 && planned < policy / 3.0, "{planned} m from the goal, {policy} m without updates");

    let mut again = model.clone();
    again.set_position_step_size();
    assert_eq!(again, model, "the step size is that of the trained motion");
}

#[test]
fn final_goals_are_recorded_goals_and_earlier_ones_hand_positions() {
    let folder = tempfile::tempdir().unwrap();
    let Config { dataset, .. } = config(folder.path());
    let dataset = Dataset::load(&dataset, &[], Input::Position).unwrap();
    let Recipe { model, training } = Preset::Jenga.recipe();
    for goals in [GoalSampling::Final, GoalSampling::Hindsight] {
        let recipe = Recipe { model: model.clone(), training: Training { goals, ..training.clone() } };
        let sampler = Sampler::new(&dataset, &recipe, 0);
        let samples = sampler.epoch(0);
        let batch = sampler.batch(0, &samples);
        let Frames::Positions(frames) = &batch.frames else { panic!("positions") };
        assert_eq!(samples.len(), STARTS.len() * ACTIONS as usize);
        assert_eq!(samples.iter().all(|sample| sample.goal == ACTIONS), goals == GoalSampling::Final);
        for (row, sample) in samples.iter().enumerate() {
            let at = |index: &[usize]| frames[index[row]];
            let start = STARTS[sample.episode as usize];
            assert_eq!(at(&batch.observations), hand(start, sample.step));
            let expected = if sample.goal == ACTIONS { GOAL } else { hand(start, sample.goal) };
            assert_eq!(at(&batch.goals), expected);
        }
    }
}

#[test]
fn mismatched_datasets_and_settings_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path());
    let refusal = |config: &Config| format!("{:#}", run::run(config, &mut StopIf(|_| false)).unwrap_err());
    let images = folder.path().join("images");
    keep(&images, &episode("reach", 1, 5));
    let message = refusal(&Config { dataset: images, ..config.clone() });
    assert!(message.ends_with("reach-1.mcap: goal_position: expected 3 values, got 0"), "{message}");
    let of_images = Config { dataset: config.dataset.clone(), ..Config::from(Preset::Cpn) };
    assert_eq!(refusal(&of_images), "model.actions: expected 3 as the demonstrations have, got 4");
    let training = Training { shift_pixels: 4, ..config.training.clone() };
    let message = refusal(&Config { training, ..config.clone() });
    assert_eq!(message, "training.shift_pixels: expected 0 to 0, got 4");
    let training = Training { colour_jitter: 0.1, ..config.training.clone() };
    let message = refusal(&Config { training, ..config });
    assert_eq!(message, "training.colour_jitter: expected 0 to 0, got 0.1");
}
