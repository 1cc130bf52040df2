//! Fixtures: demonstrations with random frames, checkpoints, sessions and recorders.

#![allow(dead_code, reason = "each test file uses its part")]

use cpn::checkpoint::{self, Provenance};
use cpn::config::{ConvConfig, ImageEncoderConfig};
use cpn::{EncoderConfig, MethodKind, Model, ModelConfig, images};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use recording::Episode;
use service_kit::SessionConfig;
use std::path::Path;
use std::sync::Arc;
use trainer::record::folder::Recordings;
use wire::Image;
use wire::demonstration::{CommitEpisodeRequest, DemonstrationStep, RecordedEpisode, digest};
use wire::sim::Variation;
use zenoh::Session;

/// Data digest in the provenance of every checkpoint.
pub const DATA_DIGEST: &str = "dddddddddddddddddddddddddddddddddddddddddddddddddddddddddddddddd";
/// Render spec of every frame.
pub const SPEC: &str = r#"{"camera":"corner2"}"#;

/// Step `step` of an episode: a random frame, and an action except at the end.
pub fn step(task: &str, seed: u64, steps: u32, step: u32) -> DemonstrationStep {
    let mut rng = ChaCha8Rng::seed_from_u64(seed * 1000 + u64::from(step));
    let mut data = vec![0; images::BYTES];
    rng.fill_bytes(&mut data);
    let side = images::SIZE as u32;
    DemonstrationStep {
        episode_id: format!("{task}-{seed}"),
        step,
        frame: Image::new(side, side, data).unwrap().rendered_as(SPEC).unwrap(),
        action: (step + 1 < steps).then(|| (0..4).map(|_| rng.random_range(-1.0..1.0)).collect()),
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

/// Commit of an episode.
pub fn commit(episode: &Episode) -> CommitEpisodeRequest {
    CommitEpisodeRequest { episode: episode.info().clone() }
}

/// Stores an episode in `folder`.
pub fn keep(folder: &Path, episode: &Episode) {
    Recordings::open(folder.to_owned()).unwrap().keep(episode).unwrap();
}

/// Checkpoint of a small, random model.
pub fn checkpoint(seed: u64) -> Vec<u8> {
    let encoder = EncoderConfig::Image(ImageEncoderConfig {
        convolutions: vec![
            ConvConfig { channels: 3, kernel: 8, stride: 8 },
            ConvConfig { channels: 4, kernel: 4, stride: 3 },
        ],
        latent: 6,
        layer_norm: true,
    });
    let config = ModelConfig { encoder, hidden: 5, gate_hidden: 4, ..ModelConfig::paper(MethodKind::Cpn) };
    let provenance = Provenance {
        training_tasks: vec!["reach".into()],
        data_digest: DATA_DIGEST.into(),
        render_spec: String::new(),
        seed,
        training: cpn::Training::paper(),
    };
    checkpoint::to_bytes(&Model::new(config, seed), &provenance).unwrap()
}

/// Two sessions: one listens, the other connects to it.
pub async fn sessions(endpoint: &str) -> (Session, Session) {
    let listening = SessionConfig { listen: vec![endpoint.into()], ..SessionConfig::default() };
    let connecting = SessionConfig { connect: vec![endpoint.into()], ..SessionConfig::default() };
    let listening = service_kit::session::open(&listening).await.unwrap();
    (listening, service_kit::session::open(&connecting).await.unwrap())
}

/// Bytes of all recordings of a folder, by relative path.
pub fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let paths = trainer::record::folder::paths(folder).unwrap();
    let name = |path: &Path| path.strip_prefix(folder).unwrap().display().to_string();
    paths.iter().map(|path| (name(path), std::fs::read(path).unwrap())).collect()
}

/// Recorder of `folder` on a session.
pub async fn record(
    session: &Session,
    folder: &Path,
    limits: trainer::record::ingest::Limits,
) -> (trainer::record::Recorder, Arc<Recordings>) {
    let recordings = Arc::new(Recordings::open(folder.to_owned()).unwrap());
    let ingest = Arc::new(trainer::record::ingest::Ingest::new(Arc::clone(&recordings), limits));
    (trainer::record::start(session, Arc::clone(&recordings), ingest).await.unwrap(), recordings)
}
