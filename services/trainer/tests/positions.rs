//! Training runs on trajectories of positions.

#![expect(clippy::unwrap_used, reason = "a test")]

mod common;

use common::{episode, info, keep, steps};
use cpn::{Agent, EncoderConfig, Input, Method, checkpoint, positions};
use recording::Episode;
use std::path::Path;
use trainer::positions::Trajectories;
use trainer::progress::StopIf;
use trainer::train::{self, Config, Demonstrations, Outcome};
use wire::demonstration::RecordedEpisode;

const GOAL: [f32; 3] = [0.7, 0.0, 0.2];

/// A hand that goes straight to the goal in `actions` equal steps, an action of 1 being 1 cm.
fn reach(seed: u64, start: [f32; 3], actions: u32) -> Episode {
    let action = [0, 1, 2].map(|axis| (GOAL[axis] - start[axis]) * 100.0 / actions as f32);
    let mut steps = steps("poke", seed, actions + 1);
    for step in &mut steps {
        step.state = (0..3).map(|axis| start[axis] + step.step as f32 * action[axis] / 100.0).collect();
        step.action = (step.step < actions).then(|| action.to_vec());
    }
    Episode::new(RecordedEpisode { goal_position: GOAL.to_vec(), ..info("poke", seed, &steps) }, steps).unwrap()
}

fn config(folder: &Path) -> Config {
    let dataset = folder.join("data");
    if !dataset.exists() {
        let starts = [[0.65, -0.03, 0.2], [0.62, 0.02, 0.22], [0.64, 0.0, 0.17], [0.66, 0.03, 0.19]];
        starts.into_iter().zip(0..).for_each(|(start, seed)| keep(&dataset, &reach(seed, start, 8)));
    }
    let out = folder.join("cpn.safetensors");
    Config { dataset, out, input: Input::Position, horizon: Some(3), batch_size: 16, threads: 1, ..Config::default() }
}

fn trained(config: &Config) -> Agent {
    let outcome = train::run(config, &mut StopIf(|_| false)).unwrap();
    assert!(matches!(outcome, Outcome::Finished { .. }));
    checkpoint::from_bytes(&std::fs::read(&config.out).unwrap()).unwrap().agent
}

/// Where the hand is predicted to be after plan upon plan.
fn end(agent: &Agent, mut hand: [f32; 3]) -> [f32; 3] {
    let x_g = agent.encode(&positions::from_metres(&[GOAL]));
    for _ in 0..4 {
        let plan = agent.plan(&agent.encode(&positions::from_metres(&[hand])), &x_g, 0);
        let moved = plan.actions.clamp(-1.0, 1.0).sum_dim_intlist([0, 1].as_slice(), false, None);
        let moved: Vec<f32> = Vec::try_from(moved).unwrap();
        hand = [0, 1, 2].map(|axis| hand[axis] + moved[axis] / 100.0);
    }
    hand
}

#[test]
fn a_model_of_positions_learns_where_to_go() {
    let folder = tempfile::tempdir().unwrap();
    let agent = trained(&Config { epochs: 150, ..config(folder.path()) });
    assert_eq!((agent.horizon(), agent.config().actions), (3, 3));
    let EncoderConfig::Position(encoder) = &agent.config().encoder else { panic!("expected positions") };
    // The mean and the spread of the hand's positions and the goal.
    assert!((645..695).contains(&encoder.centre_mm[0]) && (10..40).contains(&encoder.scale_mm), "{encoder:?}");
    let start = [0.64, 0.01, 0.2];
    let distance = |hand: [f32; 3]| hand.iter().zip(GOAL).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt();
    let (before, after) = (distance(start), distance(end(&agent, start)));
    assert!(after < before / 3.0, "{after} m from the goal, {before} m at the start");
}

#[test]
fn the_hand_rests_at_its_goal_and_a_goal_may_be_told_in_hindsight() {
    let folder = tempfile::tempdir().unwrap();
    let Config { dataset, .. } = config(folder.path());
    let given = Trajectories::load(&dataset, 0.0).unwrap();
    let moments = given.shuffled(0, 0);
    assert_eq!((moments.len(), given.sample_count(), given.action_size()), (32, 32, 3));
    let batch = given.batch(&moments, 8);
    assert_eq!(batch.mask.min().double_value(&[]), 1.0);
    assert!((&batch.goals - positions::from_metres(&[GOAL])).abs().max().double_value(&[]) < 1e-6);
    let told = Trajectories::load(&dataset, 1.0).unwrap();
    let hindsight = told.batch(&told.shuffled(0, 0), 8);
    // The actions lead from each observation to its goal, wherever that is, and no further.
    for batch in [batch, hindsight] {
        let end = &batch.observations + batch.actions.sum_dim_intlist(1, false, None) / 100.0;
        assert!((end - batch.goals).abs().max().double_value(&[]) < 1e-5);
    }
    assert_ne!(given.shuffled(0, 0), given.shuffled(0, 1));
}

#[test]
fn what_is_no_trajectory_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path());
    let refusal = |config: &Config| format!("{:#}", train::run(config, &mut StopIf(|_| false)).unwrap_err());
    let images = folder.path().join("images");
    keep(&images, &episode("reach", 1, 5));
    let message = refusal(&Config { dataset: images, ..config.clone() });
    assert!(message.ends_with("goal_position: expected 3 values, got 0"), "{message}");
    let message = refusal(&Config { hindsight: 1.5, ..config.clone() });
    assert_eq!(message, "hindsight: expected 0 to 1, got 1.5");
    let message = refusal(&Config { input: Input::Image, hindsight: 0.5, ..config.clone() });
    assert_eq!(message, "hindsight: expected 0 for images, got 0.5");
    let message = refusal(&Config { hold_out: vec!["poke".into()], ..config.clone() });
    assert_eq!(message, "hold_out: expected none for positions, got [\"poke\"]");
    let message = refusal(&Config { horizon: Some(65), ..config });
    assert_eq!(message, "horizon: expected 1 to 64, got 65");
}
