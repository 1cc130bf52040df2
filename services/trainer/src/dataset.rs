//! The demonstrations of a training run, in memory.

use crate::episode::Episode;
use anyhow::{Context, ensure};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use tch::{Device, Kind, Tensor};

/// Every frame with an action, of every episode that is not held out.
#[derive(Debug)]
pub struct Dataset {
    episodes: Vec<Episode>,
    tasks: BTreeSet<String>,
    samples: Vec<Sample>,
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
    /// `[B, 84, 84, 3]` bytes.
    pub observations: Tensor,
    /// The last frames of the same episodes, `[B, 84, 84, 3]` bytes.
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
    /// If an episode is damaged, the episodes differ in the size of their actions, none is left, or a held-out task has
    /// none, which is more likely a slip of the pen than meant.
    pub fn load(folder: &Path, held_out: &[String]) -> anyhow::Result<Self> {
        let all_tasks = names(folder)?;
        for task in held_out {
            ensure!(all_tasks.contains(task), "hold_out: expected some of {all_tasks:?}, got {task:?}");
        }
        let mut dataset =
            Self { episodes: Vec::new(), tasks: BTreeSet::new(), samples: Vec::new(), digest: String::new() };
        let mut hasher = Sha256::new();
        for task in all_tasks.into_iter().filter(|task| !held_out.contains(task)) {
            let folder = folder.join(&task);
            for name in names(&folder)?.into_iter().filter(|name| name.ends_with(".safetensors")) {
                let path: PathBuf = folder.join(name);
                let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
                hasher.update(Sha256::digest(&bytes));
                dataset.push(Episode::from_bytes(&bytes).with_context(|| path.display().to_string())?)?;
            }
            dataset.tasks.insert(task);
        }
        ensure!(!dataset.episodes.is_empty(), "{}: expected demonstrations, got none", folder.display());
        dataset.digest = hex::encode(hasher.finalize());
        Ok(dataset)
    }

    fn push(&mut self, episode: Episode) -> anyhow::Result<()> {
        if let Some(first) = self.episodes.first() {
            let (expected, got) = (first.actions.size()[1], episode.actions.size()[1]);
            ensure!(expected == got, "{}: expected {expected} action values, got {got}", episode.info.episode_id);
        }
        let index = self.episodes.len();
        self.samples.extend((0..episode.action_count()).map(|step| Sample { episode: index, step }));
        self.episodes.push(episode);
        Ok(())
    }

    /// Names of the tasks, in order.
    pub fn tasks(&self) -> impl Iterator<Item = &str> {
        self.tasks.iter().map(String::as_str)
    }

    /// Number of episodes.
    pub fn episode_count(&self) -> usize {
        self.episodes.len()
    }

    /// Number of frames with an action.
    pub fn sample_count(&self) -> usize {
        self.samples.len()
    }

    /// A, the size of an action.
    pub fn action_size(&self) -> i64 {
        self.episodes[0].actions.size()[1]
    }

    /// SHA-256 over the digests of the episodes, in hex.
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// Every sample once, in an order that the seed and the epoch decide.
    pub fn shuffled(&self, seed: u64, epoch: u64) -> Vec<Sample> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(epoch);
        let mut samples = self.samples.clone();
        samples.shuffle(&mut rng);
        samples
    }

    /// The tensors of some samples, with the next H actions of each.
    pub fn batch(&self, samples: &[Sample], horizon: i64) -> Batch {
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

/// Names in a folder, in order.
fn names(folder: &Path) -> anyhow::Result<Vec<String>> {
    let entries = std::fs::read_dir(folder).with_context(|| folder.display().to_string())?;
    let mut names = entries
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
        .collect::<anyhow::Result<Vec<_>>>()?;
    names.sort();
    Ok(names)
}
