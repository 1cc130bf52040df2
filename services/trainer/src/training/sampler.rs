//! Sampler: samples, their goals and their order in a training run, determined by data, recipe and seed.

use crate::training::augment::Augmentation;
use crate::training::dataset::{Dataset, Episode};
use cpn::recipe::{GoalSampling, Recipe, Training};
use cpn::{Batch, Frames, images};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::HashMap;

/// A sample: an observation of an episode, and a later frame as its goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    /// Index of the episode.
    pub episode: u32,
    /// Step of the observation.
    pub step: u32,
    /// Step of the goal, after the observation.
    pub goal: u32,
}

/// Sampler of a run.
#[derive(Debug, Clone, Copy)]
pub struct Sampler<'a> {
    dataset: &'a Dataset,
    training: &'a Training,
    /// H, the planning horizon.
    horizon: usize,
    /// True if the method uses the goal.
    needs_goal: bool,
    seed: u64,
}

impl<'a> Sampler<'a> {
    /// A sampler for a valid recipe.
    pub fn new(dataset: &'a Dataset, recipe: &'a Recipe, seed: u64) -> Self {
        let Recipe { model, training } = recipe;
        let needs_goal = model.method.is_goal_conditioned() || model.method.plans();
        Self { dataset, training, horizon: model.horizon as usize, needs_goal, seed }
    }

    /// Number of steps of an epoch.
    pub fn steps_per_epoch(&self) -> u64 {
        self.dataset.sample_count().div_ceil(self.training.batch_size) as u64
    }

    /// Number of samples in the first `step` steps of a run.
    pub fn samples_before(&self, step: u64) -> u64 {
        let (epochs, steps) = (step / self.steps_per_epoch(), step % self.steps_per_epoch());
        epochs * self.dataset.sample_count() as u64 + steps * self.training.batch_size as u64
    }

    /// Batches of a run from step `start` on, without end.
    pub fn batches(self, start: u64) -> impl Iterator<Item = Batch> {
        let per_epoch = self.steps_per_epoch();
        let epochs = (start / per_epoch..).map(move |epoch| (epoch, self.epoch(epoch)));
        epochs.flat_map(move |(epoch, samples)| {
            let first = epoch * per_epoch;
            let size = self.training.batch_size;
            let steps = (start.saturating_sub(first)..per_epoch).collect::<Vec<_>>();
            steps.into_iter().map(move |step| {
                let from = step as usize * size;
                self.batch(first + step, &samples[from..samples.len().min(from + size)])
            })
        })
    }

    /// Samples of an epoch: all frames with an action once, in an order determined by seed and epoch.
    pub fn epoch(&self, epoch: u64) -> Vec<Sample> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(epoch);

        let mut draws = Vec::new();
        for (index, episode) in self.dataset.episodes().iter().enumerate() {
            let mut steps: Vec<usize> = (0..episode.action_count).collect();
            let size = self.training.samples_per_draw;
            if self.needs_next() {
                // Successive samples share most of the frames after them. Segments begin elsewhere in each epoch.
                let (first, rest) = steps.split_at(rng.random_range(0..size).min(steps.len()));
                draws.extend([first].into_iter().chain(rest.chunks(size)).map(|steps| (index, steps.to_vec())));
            } else {
                steps.shuffle(&mut rng);
                draws.extend(steps.chunks(size).map(|steps| (index, steps.to_vec())));
            }
        }
        draws.shuffle(&mut rng);

        let mut samples = Vec::with_capacity(self.dataset.sample_count());
        for (index, steps) in draws {
            let last = self.dataset.episodes()[index].action_count;
            for step in steps {
                let goal = match self.training.goals {
                    GoalSampling::Final => last as u32,
                    GoalSampling::WithinHorizon => {
                        let reach = (step + self.horizon * self.training.action_block).min(last);
                        rng.random_range(step as u32 + 1..=reach as u32)
                    }
                    GoalSampling::Hindsight => rng.random_range(step as u32 + 1..=last as u32),
                };
                samples.push(Sample { episode: index as u32, step: step as u32, goal });
            }
        }
        samples
    }

    /// The batch of `samples`; `step` of the run determines the augmentation.
    pub fn batch(&self, step: u64, samples: &[Sample]) -> Batch {
        let (horizon, size) = (self.horizon, self.dataset.action_size());
        let mut frames = BatchFrames { dataset: self.dataset, rows: HashMap::new(), frames: Vec::new() };
        let (mut observations, mut goals) = (Vec::with_capacity(samples.len()), Vec::with_capacity(samples.len()));
        let mut actions = vec![0.0; samples.len() * horizon * size];
        let mut mask = vec![0.0; samples.len() * horizon];
        let mut applied_actions = vec![0.0; if self.needs_next() { actions.len() } else { 0 }];
        let mut next = Vec::new();

        for (row, sample) in samples.iter().enumerate() {
            observations.push(frames.row(sample.episode, sample.step));
            // The observation is a placeholder for methods without a goal: it adds no frame to the batch.
            goals.push(frames.row(sample.episode, if self.needs_goal { sample.goal } else { sample.step }));
            let episode = &self.dataset.episodes()[sample.episode as usize];
            for t in 0..horizon {
                let at = row * horizon + t;
                if self.block(self.dataset.actions(), episode, sample, t, &mut actions[at * size..][..size]) {
                    mask[at] = 1.0;
                }
                if self.needs_next() {
                    let applied = &mut applied_actions[at * size..][..size];
                    self.block(self.dataset.applied_actions(), episode, sample, t, applied);
                    let step = sample.step as usize + (t + 1) * self.training.action_block;
                    next.push(frames.row(sample.episode, sample.goal.min(step as u32)));
                }
            }
        }
        let positions = if self.training.losses.position > 0.0 {
            frames.frames.iter().map(|&(_, index)| self.dataset.hand_positions()[index]).collect()
        } else {
            Vec::new()
        };
        let steps_left = samples.iter().map(|sample| sample.goal - sample.step).collect();
        Batch {
            frames: self.frames(step, &frames.frames),
            observations,
            goals,
            steps_left,
            actions,
            applied_actions,
            mask,
            next,
            positions,
        }
    }

    /// True if the frames after a sample's actions are in the batch.
    fn needs_next(&self) -> bool {
        self.training.losses.dynamics > 0.0
    }

    /// Frames by episode and index in the dataset; images are augmented.
    fn frames(&self, step: u64, frames: &[(u32, usize)]) -> Frames {
        match self.dataset.frames() {
            Frames::Images(pixels) => {
                let mut augmentations = HashMap::new();
                let mut augmented = Vec::with_capacity(frames.len() * images::BYTES);
                for &(episode, index) in frames {
                    let draw = || Augmentation::draw(self.training, self.seed, step, episode);
                    let frame = &pixels[index * images::BYTES..][..images::BYTES];
                    augmentations.entry(episode).or_insert_with(draw).append(frame, &mut augmented);
                }
                Frames::Images(augmented)
            }
            Frames::Positions(all) => Frames::Positions(frames.iter().map(|&(_, index)| all[index]).collect()),
        }
    }

    /// Block t of `actions`, `[actions, A]`, after a sample's observation: adds the mean of its actions before the goal to `mean`;
    /// false if there is none.
    fn block(&self, actions: &[f32], episode: &Episode, sample: &Sample, t: usize, mean: &mut [f32]) -> bool {
        let block = self.training.action_block;
        let first = sample.step as usize + t * block;
        let count = block.min((sample.goal as usize).saturating_sub(first));
        let first = episode.first_action + first.min(episode.action_count);
        let actions = &actions[first * mean.len()..][..count * mean.len()];
        for action in actions.chunks_exact(mean.len()) {
            for (mean, value) in mean.iter_mut().zip(action) {
                *mean += value / count as f32;
            }
        }
        count > 0
    }
}

/// Distinct frames of a batch.
struct BatchFrames<'a> {
    dataset: &'a Dataset,
    /// Rows in the batch, by index in the dataset.
    rows: HashMap<usize, usize>,
    /// Episode and index in the dataset, by row.
    frames: Vec<(u32, usize)>,
}

impl BatchFrames<'_> {
    /// Row of a frame, which is added if new.
    fn row(&mut self, episode: u32, step: u32) -> usize {
        let index = self.dataset.episodes()[episode as usize].first_frame + step as usize;
        let next = self.frames.len();
        let row = *self.rows.entry(index).or_insert(next);
        if row == next {
            self.frames.push((episode, index));
        }
        row
    }
}
