//! Demonstrations with random frames.

use cpn::images;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use recording::Episode;
use std::path::Path;
use trainer::record::folder::Recordings;
use wire::Image;
use wire::demonstration::{DemonstrationStep, RecordedEpisode, digest};
use wire::sim::Variation;

/// Render spec of every frame.
pub const SPEC: &str = r#"{"camera":"corner2"}"#;

/// Step `step` of an episode: a random frame, and an action except at the end; at every third step another one is applied.
pub fn step(task: &str, seed: u64, steps: u32, step: u32) -> DemonstrationStep {
    let mut rng = ChaCha8Rng::seed_from_u64(seed * 1000 + u64::from(step));
    let mut data = vec![0; images::BYTES];
    rng.fill_bytes(&mut data);
    let side = images::SIZE as u32;
    let action: Option<Vec<f32>> = (step + 1 < steps).then(|| (0..4).map(|_| rng.random_range(-1.0..1.0)).collect());
    DemonstrationStep {
        episode_id: format!("{task}-{seed}"),
        step,
        frame: Image::new(side, side, data).unwrap().rendered_as(SPEC).unwrap(),
        applied_action: action
            .clone()
            .filter(|_| step % 3 == 1)
            .map(|action| action.iter().map(|value| -value).collect()),
        action,
        state: vec![step as f32 * 0.01, 0.5, 0.2],
        reward: step as f32,
        success: step + 1 == steps,
    }
}

/// All steps of an episode.
pub fn steps(task: &str, seed: u64, count: u32) -> Vec<DemonstrationStep> {
    (0..count).map(|number| step(task, seed, count, number)).collect()
}

/// Metadata of an episode of these steps.
pub fn info(task: &str, seed: u64, steps: &[DemonstrationStep]) -> RecordedEpisode {
    RecordedEpisode {
        episode_id: format!("{task}-{seed}"),
        variation: Variation { task: task.to_owned(), seed },
        steps: steps.len() as u32,
        digest: digest(steps),
        goal_position: Vec::new(),
        control_hz: 80.0,
        render_spec: steps[0].frame.render_spec().to_owned(),
    }
}

/// Episode with `count` steps.
pub fn episode(task: &str, seed: u64, count: u32) -> Episode {
    let steps = steps(task, seed, count);
    Episode::new(info(task, seed, &steps), steps).unwrap()
}

/// Stores an episode in `folder`.
pub fn keep(folder: &Path, episode: &Episode) {
    Recordings::open(folder.to_owned()).unwrap().keep(episode).unwrap();
}
