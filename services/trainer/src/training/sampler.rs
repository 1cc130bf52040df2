//! Which samples a training run sees, in which order, towards which goals: a function of the data, the recipe and the seed.

use crate::training::augment::Look;
use crate::training::dataset::{Dataset, Episode};
use cpn::recipe::{GoalSampling, Recipe, Training};
use cpn::{Batch, Frames, images};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::HashMap;

/// A moment of an episode and what it is to lead to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    /// The episode among all.
    pub episode: u32,
    /// Step of the observation.
    pub step: u32,
    /// Step of the goal, a later one.
    pub goal: u32,
}

/// Draws the samples of a run.
#[derive(Debug, Clone, Copy)]
pub struct Sampler<'a> {
    dataset: &'a Dataset,
    training: &'a Training,
    /// H.
    horizon: usize,
    /// Whether the method looks at the goal.
    needs_goal: bool,
    seed: u64,
}

impl<'a> Sampler<'a> {
    /// For a valid recipe.
    pub fn new(dataset: &'a Dataset, recipe: &'a Recipe, seed: u64) -> Self {
        let Recipe { model, training } = recipe;
        let needs_goal = model.method.is_goal_conditioned() || model.method.plans();
        Self { dataset, training, horizon: model.horizon as usize, needs_goal, seed }
    }

    /// Steps of an epoch.
    pub fn steps_per_epoch(&self) -> u64 {
        self.dataset.sample_count().div_ceil(self.training.batch_size) as u64
    }

    /// Samples of the first `step` steps of a run.
    pub fn samples_before(&self, step: u64) -> u64 {
        let (epochs, steps) = (step / self.steps_per_epoch(), step % self.steps_per_epoch());
        epochs * self.dataset.sample_count() as u64 + steps * self.training.batch_size as u64
    }

    /// The batches of a run from step `start` on, one after the other, for as long as they are asked for.
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

    /// Every frame with an action once, in an order that the seed and the epoch decide.
    pub fn epoch(&self, epoch: u64) -> Vec<Sample> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(epoch);
        let mut draws = Vec::new();
        for (index, episode) in self.dataset.episodes().iter().enumerate() {
            let mut steps: Vec<usize> = (0..episode.action_count).collect();
            steps.shuffle(&mut rng);
            draws.extend(steps.chunks(self.training.samples_per_draw).map(|steps| (index, steps.to_vec())));
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

    /// The batch of some samples, those of step `step` of the run, which decides how the images are changed.
    pub fn batch(&self, step: u64, samples: &[Sample]) -> Batch {
        let (horizon, size) = (self.horizon, self.dataset.action_size());
        let mut rows = Rows { dataset: self.dataset, places: HashMap::new(), frames: Vec::new() };
        let (mut observations, mut goals) = (Vec::with_capacity(samples.len()), Vec::with_capacity(samples.len()));
        let mut actions = vec![0.0; samples.len() * horizon * size];
        let mut mask = vec![0.0; samples.len() * horizon];
        for (row, sample) in samples.iter().enumerate() {
            observations.push(rows.place(sample.episode, sample.step));
            // Any frame will do for a method that does not look.
            goals.push(rows.place(sample.episode, if self.needs_goal { sample.goal } else { sample.step }));
            let episode = &self.dataset.episodes()[sample.episode as usize];
            for t in 0..horizon {
                let at = row * horizon + t;
                if self.block(episode, sample, t, &mut actions[at * size..][..size]) {
                    mask[at] = 1.0;
                }
            }
        }
        Batch { frames: self.frames(step, &rows.frames), observations, goals, actions, mask }
    }

    /// Some frames, each of an episode and at an index among all, as the encoder takes them.
    fn frames(&self, step: u64, frames: &[(u32, usize)]) -> Frames {
        match self.dataset.frames() {
            Frames::Images(pixels) => {
                let (mut looks, mut changed) = (HashMap::new(), Vec::with_capacity(frames.len() * images::BYTES));
                for &(episode, index) in frames {
                    let draw = || Look::draw(self.training, self.seed, step, episode);
                    let frame = &pixels[index * images::BYTES..][..images::BYTES];
                    looks.entry(episode).or_insert_with(draw).append(frame, &mut changed);
                }
                Frames::Images(changed)
            }
            Frames::Positions(all) => Frames::Positions(frames.iter().map(|&(_, index)| all[index]).collect()),
        }
    }

    /// The mean of the actions that planned action t stands for, up to the goal; whether there is any.
    fn block(&self, episode: &Episode, sample: &Sample, t: usize, mean: &mut [f32]) -> bool {
        let block = self.training.action_block;
        let first = sample.step as usize + t * block;
        let count = block.min((sample.goal as usize).saturating_sub(first));
        let actions = self.dataset.actions(episode.first_action + first.min(episode.action_count), count);
        for action in actions.chunks_exact(mean.len()) {
            for (mean, value) in mean.iter_mut().zip(action) {
                *mean += value / count as f32;
            }
        }
        count > 0
    }
}

/// The distinct frames of a batch.
struct Rows<'a> {
    dataset: &'a Dataset,
    /// By index among all frames, the row.
    places: HashMap<usize, usize>,
    /// By row, the episode and the index.
    frames: Vec<(u32, usize)>,
}

impl Rows<'_> {
    /// The row of a frame, which is added if it is new.
    fn place(&mut self, episode: u32, step: u32) -> usize {
        let index = self.dataset.episodes()[episode as usize].first_frame + step as usize;
        let next = self.frames.len();
        let place = *self.places.entry(index).or_insert(next);
        if place == next {
            self.frames.push((episode, index));
        }
        place
    }
}
