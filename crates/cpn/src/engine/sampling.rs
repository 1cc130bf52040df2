//! Searches that try plans and keep what came near the goal.

use super::inner::{Actions, Purpose};
use super::planner::{BLOCK, Dynamics, Worker};
use crate::method::{Plan, Query, Solver};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

/// Spread of the first generation, of actions that reach from -1 to 1; MPPI's keeps it.
const SPREAD: f32 = 0.5;
/// CEM's spread never falls below, so that it goes on looking.
const LEAST_SPREAD: f32 = 0.05;
/// One of so many plans is among the best that the next generation is drawn around.
const ELITE: usize = 8;
/// MPPI's temperature, in standard deviations of the generation's losses.
const TEMPERATURE: f32 = 0.1;

/// Actions `[H][A]` with their inner loss.
#[derive(Debug, Clone)]
struct Candidate {
    actions: Vec<Vec<f32>>,
    loss: f32,
}

/// Where the next generation is drawn.
#[derive(Debug)]
struct Belief {
    /// `[H][A]`.
    mean: Vec<Vec<f32>>,
    spread: Vec<Vec<f32>>,
}

/// A search generation after generation, from the policy's actions or the query's own; the same for the same seed. It can be left
/// after any piece of a generation and taken up again.
#[derive(Debug)]
pub(crate) struct Sampling {
    rng: ChaCha8Rng,
    best: Candidate,
    belief: Belief,
    /// Of the best plan before each generation and after the last.
    inner_losses: Vec<f32>,
    /// Generations after which the best plan was found.
    found: usize,
    /// Generations that are whole.
    pub(crate) done: usize,
    /// What has been tried of the next one.
    generation: Vec<Candidate>,
    /// Rollouts so far.
    pub(crate) rollouts: usize,
}

impl Sampling {
    /// Rolls out the plan that the first generation is drawn around.
    pub(super) fn begin(worker: &mut Worker<f32>, dynamics: &Dynamics<f32>, query: Query<'_>) -> Self {
        let source = if query.start.is_empty() { Actions::Proposed } else { Actions::Given };
        worker.set_plan(dynamics, 1, 0, query.start);
        let loss = roll_out(worker, dynamics, query, (source, Purpose::Loss));
        let best = Candidate { actions: worker.plan(dynamics, 1, 0), loss };
        let spread = best.actions.iter().map(|action| vec![SPREAD; action.len()]).collect();
        Self {
            rng: ChaCha8Rng::seed_from_u64(query.seed),
            belief: Belief { mean: best.actions.clone(), spread },
            best,
            inner_losses: vec![loss],
            found: 0,
            done: 0,
            generation: Vec::new(),
            rollouts: 1,
        }
    }

    /// Tries a block of plans for each worker and, with the last of a generation, learns from it.
    pub(super) fn go_on(
        &mut self,
        workers: &mut [Worker<f32>],
        dynamics: &Dynamics<f32>,
        query: Query<'_>,
        solver: Solver,
    ) {
        let (Solver::Cem(count) | Solver::Mppi(count) | Solver::Hybrid(count)) = solver else { return };
        let tried = self.generation.len();
        let piece = (count - tried).min(BLOCK * workers.len());
        self.generation.extend(draw(&self.belief, piece, &mut self.rng));
        evaluate(workers, dynamics, query, &mut self.generation[tried..]);
        self.rollouts += piece;
        if self.generation.len() == count {
            self.learn(&mut workers[0], dynamics, query, solver);
        }
    }

    /// Ends a generation.
    fn learn(&mut self, worker: &mut Worker<f32>, dynamics: &Dynamics<f32>, query: Query<'_>, solver: Solver) {
        self.done += 1;
        let mut generation = std::mem::take(&mut self.generation);
        generation.sort_by(|a, b| a.loss.total_cmp(&b.loss));
        let mut nearest = generation[0].clone();
        match solver {
            Solver::Mppi(_) => self.belief.mean = weighted_mean(&generation),
            _ => self.belief = around(&generation[..(generation.len() / ELITE).max(2).min(generation.len())]),
        }
        if let Solver::Hybrid(_) = solver {
            worker.set_plan(dynamics, 1, 0, &self.belief.mean);
            roll_out(worker, dynamics, query, (Actions::Given, Purpose::Gradient));
            worker.descend(dynamics, 1);
            let loss = roll_out(worker, dynamics, query, (Actions::Moved, Purpose::Loss));
            let descended = Candidate { actions: worker.plan(dynamics, 1, 0), loss };
            if descended.loss < nearest.loss {
                self.belief.mean.clone_from(&descended.actions);
                nearest = descended;
            }
        }
        if nearest.loss < self.best.loss {
            (self.best, self.found) = (nearest, self.done);
        }
        self.inner_losses.push(self.best.loss);
    }

    /// The best plan of the generations that are whole.
    pub(crate) fn into_plan(self) -> Plan {
        Plan { actions: self.best.actions, inner_losses: self.inner_losses, iterations: self.found }
    }
}

/// The inner loss of the worker's one plan.
fn roll_out(worker: &mut Worker<f32>, dynamics: &Dynamics<f32>, query: Query<'_>, how: (Actions, Purpose)) -> f32 {
    worker.roll_out(dynamics, how, [(query.x, query.x_g)].into_iter()).sum()
}

/// Fills in the losses, of a block for each worker at most.
fn evaluate(workers: &mut [Worker<f32>], dynamics: &Dynamics<f32>, query: Query<'_>, candidates: &mut [Candidate]) {
    if candidates.len() <= BLOCK {
        // Another thread would only have to be woken.
        return evaluate_block(&mut workers[0], dynamics, query, candidates);
    }
    let blocks = workers.par_iter_mut().zip(candidates.par_chunks_mut(BLOCK));
    blocks.for_each(|(worker, block)| evaluate_block(worker, dynamics, query, block));
}

fn evaluate_block(worker: &mut Worker<f32>, dynamics: &Dynamics<f32>, query: Query<'_>, block: &mut [Candidate]) {
    let rows = block.len();
    for (r, candidate) in block.iter().enumerate() {
        worker.set_plan(dynamics, rows, r, &candidate.actions);
    }
    let ends = std::iter::repeat_n((query.x, query.x_g), rows);
    let losses = worker.roll_out(dynamics, (Actions::Given, Purpose::Loss), ends);
    for (candidate, loss) in block.iter_mut().zip(losses) {
        candidate.loss = loss;
    }
}

fn draw(belief: &Belief, count: usize, rng: &mut ChaCha8Rng) -> Vec<Candidate> {
    let mut around = |mean: f32, spread: f32| {
        let noise: f32 = StandardNormal.sample(rng);
        (mean + spread * noise).clamp(-1.0, 1.0)
    };
    let mut action = |(mean, spread): (&Vec<f32>, &Vec<f32>)| {
        mean.iter().zip(spread).map(|(mean, spread)| around(*mean, *spread)).collect::<Vec<_>>()
    };
    let mut one = || belief.mean.iter().zip(&belief.spread).map(&mut action).collect();
    (0..count).map(|_| Candidate { actions: one(), loss: f32::INFINITY }).collect()
}

/// Mean and standard deviation of the elites.
fn around(elites: &[Candidate]) -> Belief {
    let share = 1.0 / elites.len() as f32;
    let mean = mean(elites.iter().map(|elite| (share, &elite.actions)));
    let spread = |t: usize, i: usize| {
        let squares = elites.iter().map(|elite| (elite.actions[t][i] - mean[t][i]).powi(2));
        (share * squares.sum::<f32>()).sqrt().max(LEAST_SPREAD)
    };
    let spread = (0..mean.len()).map(|t| (0..mean[t].len()).map(|i| spread(t, i)).collect()).collect();
    Belief { mean, spread }
}

/// The mean of a sorted generation, weighted by exp(-loss / temperature).
fn weighted_mean(generation: &[Candidate]) -> Vec<Vec<f32>> {
    let count = generation.len() as f32;
    let centre = generation.iter().map(|candidate| candidate.loss).sum::<f32>() / count;
    let variance = generation.iter().map(|candidate| (candidate.loss - centre).powi(2)).sum::<f32>() / count;
    let temperature = (TEMPERATURE * variance.sqrt()).max(f32::MIN_POSITIVE);
    let least = generation[0].loss;
    let weights: Vec<f32> = generation.iter().map(|candidate| ((least - candidate.loss) / temperature).exp()).collect();
    let sum: f32 = weights.iter().sum();
    mean(generation.iter().zip(weights).map(|(candidate, weight)| (weight / sum, &candidate.actions)))
}

fn mean<'a>(weighted: impl Iterator<Item = (f32, &'a Vec<Vec<f32>>)>) -> Vec<Vec<f32>> {
    let mut sum: Vec<Vec<f32>> = Vec::new();
    for (weight, actions) in weighted {
        if sum.is_empty() {
            sum = actions.iter().map(|action| vec![0.0; action.len()]).collect();
        }
        for (sum, value) in sum.iter_mut().flatten().zip(actions.iter().flatten()) {
            *sum += weight * value;
        }
    }
    sum
}
