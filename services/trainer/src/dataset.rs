//! The demonstrations of a training run, in memory.

use crate::episode::Episode;
use crate::recordings::{self, dataset_digest, tasks_of};
use crate::train::Demonstrations;
use anyhow::{Context, ensure};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use std::path::Path;
use tch::{Device, Kind, Tensor};
use wire::demonstration::RecordedEpisode;

/// Every frame with an action, of every episode that is not held out.
#[derive(Debug)]
pub struct Dataset {
    episodes: Vec<Episode>,
    samples: Vec<Sample>,
    infos: Vec<RecordedEpisode>,
    render_spec: String,
    digest: String,
}

/// A moment of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    episode: usize,
    step: usize,
}

/// The tensors of a training step.
#[derive(Debug)]
pub struct Batch {
    /// `[B, 84, 84, 3]` bytes, or `[B, 3]` metres.
    pub observations: Tensor,
    /// The last frames of the same episodes, or where they were to go; like the observations.
    pub goals: Tensor,
    /// The actions that follow, `[B, H, A]`; 0 past the end.
    pub actions: Tensor,
    /// 1 where there is an action, `[B, H]`.
    pub mask: Tensor,
}

impl Dataset {
    /// Reads every episode of `folder` but those of the `held_out` tasks.
    ///
    /// # Errors
    /// If a recording is damaged, the episodes differ in the size of their actions or in how they were rendered, none is
    /// left, or a held-out task has none, which is more likely a slip of the pen than meant.
    pub fn load(folder: &Path, held_out: &[String]) -> anyhow::Result<Self> {
        let all_tasks = recordings::tasks(folder)?;
        for task in held_out {
            ensure!(all_tasks.contains(task), "hold_out: expected some of {all_tasks:?}, got {task:?}");
        }
        let mut dataset = Self {
            episodes: Vec::new(),
            samples: Vec::new(),
            infos: Vec::new(),
            render_spec: String::new(),
            digest: String::new(),
        };
        let held_out: Vec<_> = held_out.iter().map(|task| folder.join(task)).collect();
        for path in recordings::paths(folder)? {
            if !held_out.iter().any(|task| path.starts_with(task)) {
                let episode = recordings::read(folder, &path)?;
                dataset.push(&episode).with_context(|| path.display().to_string())?;
            }
        }
        ensure!(!dataset.episodes.is_empty(), "{}: expected demonstrations, got none", folder.display());
        dataset.digest = dataset_digest(&dataset.infos);
        Ok(dataset)
    }

    fn push(&mut self, recording: &recording::Episode) -> anyhow::Result<()> {
        let episode = Episode::from_recording(recording)?;
        if let Some(first) = self.episodes.first() {
            let (expected, got) = (first.actions.size()[1], episode.actions.size()[1]);
            ensure!(expected == got, "actions: expected {expected} values like the episodes before, got {got}");
            let (expected, got) = (&self.render_spec, &recording.info().render_spec);
            ensure!(expected == got, "render_spec: expected {expected:?} like the episodes before, got {got:?}");
        }
        self.render_spec.clone_from(&recording.info().render_spec);
        let index = self.episodes.len();
        self.samples.extend((0..episode.action_count()).map(|step| Sample { episode: index, step }));
        self.episodes.push(episode);
        self.infos.push(recording.info().clone());
        Ok(())
    }
}

impl Demonstrations for Dataset {
    type Sample = Sample;

    fn tasks(&self) -> Vec<String> {
        tasks_of(&self.infos)
    }

    fn render_spec(&self) -> &str {
        &self.render_spec
    }

    fn episode_count(&self) -> usize {
        self.episodes.len()
    }

    fn sample_count(&self) -> usize {
        self.samples.len()
    }

    fn action_size(&self) -> i64 {
        self.episodes[0].actions.size()[1]
    }

    fn digest(&self) -> &str {
        &self.digest
    }

    fn shuffled(&self, seed: u64, epoch: u64) -> Vec<Sample> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(epoch);
        let mut samples = self.samples.clone();
        samples.shuffle(&mut rng);
        samples
    }

    fn batch(&self, samples: &[Sample], horizon: i64) -> Batch {
        let options = (Kind::Float, Device::Cpu);
        let size = samples.len() as i64;
        let actions = Tensor::zeros([size, horizon, self.action_size()], options);
        let mask = Tensor::zeros([size, horizon], options);
        let (mut observations, mut goals) = (Vec::with_capacity(samples.len()), Vec::with_capacity(samples.len()));
        for (row, sample) in samples.iter().enumerate() {
            let episode = &self.episodes[sample.episode];
            let (row, step, length) = (row as i64, sample.step as i64, episode.action_count() as i64);
            observations.push(episode.frames.get(step));
            goals.push(episode.frames.get(length));
            let known = horizon.min(length - step);
            actions.get(row).narrow(0, 0, known).copy_(&episode.actions.narrow(0, step, known));
            let _ = mask.get(row).narrow(0, 0, known).fill_(1.0);
        }
        Batch { observations: Tensor::stack(&observations, 0), goals: Tensor::stack(&goals, 0), actions, mask }
    }
}
