//! Demonstrations as trajectories of positions (section "JENGA domain on a physical robot").

use crate::dataset::Batch;
use crate::recordings::{self, dataset_digest, tasks_of};
use crate::train::Demonstrations;
use anyhow::{Context, ensure};
use cpn::{EncoderConfig, positions};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::Path;
use tch::Tensor;
use wire::Error;
use wire::demonstration::RecordedEpisode;

/// Every trajectory of a folder, in memory.
#[derive(Debug)]
pub struct Trajectories {
    trajectories: Vec<Trajectory>,
    infos: Vec<RecordedEpisode>,
    digest: String,
    /// Share of the moments whose goal is told in hindsight.
    hindsight: f64,
}

/// T actions and the positions of the hand before, between and after them.
#[derive(Debug)]
struct Trajectory {
    /// T + 1, in metres.
    positions: Vec<[f32; 3]>,
    /// Where the hand was to go, in metres.
    goal: [f32; 3],
    /// T.
    actions: Vec<Vec<f32>>,
}

/// A moment of a trajectory, and what is told to be its goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moment {
    trajectory: usize,
    step: usize,
    /// Step whose position is the goal, in hindsight; none for the goal that was given.
    reached: Option<usize>,
}

impl Trajectory {
    fn from_recording(recording: &recording::Episode) -> Result<Self, Error> {
        let hand = |state: &[f32]| state.first_chunk().copied();
        let steps = recording.steps();
        let positions = steps.iter().map(|step| {
            let missing =
                || Error::invalid(format!("steps[{}].state", step.step), "at least 3 values", step.state.len());
            hand(&step.state).ok_or_else(missing)
        });
        let goal = &recording.info().goal_position;
        Ok(Self {
            positions: positions.collect::<Result<_, _>>()?,
            goal: hand(goal).ok_or_else(|| Error::invalid("goal_position", "3 values", goal.len()))?,
            actions: steps.iter().filter_map(|step| step.action.clone()).collect(),
        })
    }
}

impl Trajectories {
    /// Reads every episode of `folder`; a share of `hindsight` of the moments gets a position as its goal that the hand
    /// reached later.
    ///
    /// # Errors
    /// If the share is none, a recording is damaged or has no goal position, the episodes differ in the size of their actions, or there is
    /// none.
    pub fn load(folder: &Path, hindsight: f64) -> anyhow::Result<Self> {
        ensure!((0.0..=1.0).contains(&hindsight), "hindsight: expected 0 to 1, got {hindsight}");
        let (mut trajectories, mut infos) = (Vec::<Trajectory>::new(), Vec::new());
        for path in recordings::paths(folder)? {
            let recording = recordings::read(folder, &path)?;
            let trajectory = Trajectory::from_recording(&recording).with_context(|| path.display().to_string())?;
            let got = trajectory.actions[0].len();
            let expected = trajectories.first().map_or(got, |first| first.actions[0].len());
            ensure!(expected == got, "actions: expected {expected} values like the episodes before, got {got}");
            trajectories.push(trajectory);
            infos.push(recording.info().clone());
        }
        ensure!(!trajectories.is_empty(), "{}: expected demonstrations, got none", folder.display());
        let digest = dataset_digest(&infos);
        Ok(Self { trajectories, infos, digest, hindsight })
    }

    /// The encoder for these positions: about their mean, in units of their standard deviation over all axes.
    pub fn encoder(&self) -> EncoderConfig {
        let all: Vec<[f32; 3]> =
            self.trajectories.iter().flat_map(|t| t.positions.iter().chain([&t.goal])).copied().collect();
        let positions = positions::from_metres(&all);
        let centre = positions.mean_dim(0, false, None);
        let scale = (&positions - &centre).square().mean(None).sqrt();
        let mm = |metres: f64| (1e3 * metres).round() as i64;
        let centre_mm = [0, 1, 2].map(|axis| mm(centre.double_value(&[axis])));
        EncoderConfig::position(centre_mm, mm(scale.double_value(&[])).max(1))
    }
}

impl Demonstrations for Trajectories {
    type Sample = Moment;

    fn tasks(&self) -> Vec<String> {
        tasks_of(&self.infos)
    }

    fn episode_count(&self) -> usize {
        self.trajectories.len()
    }

    fn sample_count(&self) -> usize {
        self.trajectories.iter().map(|trajectory| trajectory.actions.len()).sum()
    }

    fn action_size(&self) -> i64 {
        self.trajectories[0].actions[0].len() as i64
    }

    fn digest(&self) -> &str {
        &self.digest
    }

    /// No frame is looked at.
    fn render_spec(&self) -> &str {
        ""
    }

    fn shuffled(&self, seed: u64, epoch: u64) -> Vec<Moment> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(epoch);
        let mut moments = Vec::with_capacity(self.sample_count());
        for (trajectory, Trajectory { actions, .. }) in self.trajectories.iter().enumerate() {
            moments.extend((0..actions.len()).map(|step| {
                let reached = rng.random_bool(self.hindsight).then(|| rng.random_range(step + 1..=actions.len()));
                Moment { trajectory, step, reached }
            }));
        }
        moments.shuffle(&mut rng);
        moments
    }

    /// At its goal the hand rests: actions past it are 0, and count.
    fn batch(&self, moments: &[Moment], horizon: i64) -> Batch {
        let (mut observations, mut goals, mut actions) = (Vec::new(), Vec::new(), Vec::new());
        for &Moment { trajectory, step, reached } in moments {
            let trajectory = &self.trajectories[trajectory];
            observations.push(trajectory.positions[step]);
            goals.push(reached.map_or(trajectory.goal, |step| trajectory.positions[step]));
            let end = (step + horizon as usize).min(reached.unwrap_or(trajectory.actions.len()));
            actions.extend(trajectory.actions[step..end].iter().flatten());
            actions.resize(observations.len() * (horizon * self.action_size()) as usize, 0.0);
        }
        let size = moments.len() as i64;
        let actions = Tensor::from_slice(&actions).view([size, horizon, self.action_size()]);
        let (observations, goals) = (positions::from_metres(&observations), positions::from_metres(&goals));
        Batch { mask: actions.ones_like().select(2, 0), observations, goals, actions }
    }
}
