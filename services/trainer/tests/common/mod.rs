//! Demonstrations of noise.

#![allow(dead_code, reason = "each test file uses its part")]

use cpn::images;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::Path;
use trainer::ingest::Ingest;
use wire::Image;
use wire::demonstration::{CommitEpisodeRequest, DemonstrationStep};
use wire::sim::Variation;

/// The commit of an episode with `steps` steps.
pub fn commit(task: &str, seed: u64, steps: u32) -> CommitEpisodeRequest {
    let variation = Variation { task: task.to_owned(), seed };
    CommitEpisodeRequest { episode_id: format!("{task}-{seed}"), variation, steps }
}

/// Step `step` of an episode: noise, and an action except at the end.
pub fn step(commit: &CommitEpisodeRequest, step: u32) -> DemonstrationStep {
    let mut rng = ChaCha8Rng::seed_from_u64(commit.variation.seed * 1000 + u64::from(step));
    let mut data = vec![0; images::BYTES];
    rng.fill_bytes(&mut data);
    let side = images::SIZE as u32;
    let frame = Image::new(side, side, data).unwrap();
    let action = (step + 1 < commit.steps).then(|| (0..4).map(|_| rng.random_range(-1.0..1.0)).collect());
    DemonstrationStep { episode_id: commit.episode_id.clone(), step, frame, action }
}

/// Keeps an episode in `folder`.
pub fn keep(folder: &Path, commit: &CommitEpisodeRequest) {
    let ingest = Ingest::new(folder.to_owned());
    (0..commit.steps).for_each(|number| ingest.step(step(commit, number)));
    assert!(ingest.commit(commit).unwrap().missing_steps.is_empty());
}
