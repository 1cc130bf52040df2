//! Sampling-based searches: CEM, MPPI, and CEM with gradient steps.

use super::block::{Actions, PlanBlock, Purpose};
use super::query::{Plan, Query, Solver};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

/// Standard deviation of the first generation, for actions from -1 to 1; constant in MPPI.
const INITIAL_STD: f32 = 0.5;
/// Lower bound of CEM's standard deviation, so that exploration does not end.
const MIN_STD: f32 = 0.05;
/// Ratio of a generation's plans to its elites.
const PLANS_PER_ELITE: usize = 8;
/// Temperature of MPPI, in standard deviations of the generation's losses.
const TEMPERATURE: f32 = 0.1;

/// A plan, `[H][A]`, with its inner loss.
#[derive(Debug, Clone)]
struct Candidate {
    actions: Vec<Vec<f32>>,
    loss: f32,
}

/// Normal distribution of the next generation, independent for each action.
#[derive(Debug)]
struct ActionDistribution {
    /// `[H][A]`.
    mean: Vec<Vec<f32>>,
    /// Standard deviation, `[H][A]`.
    std: Vec<Vec<f32>>,
}

/// State of a sampling-based search, from the policy's actions or the query's start. Equal seeds give equal plans. It can be
/// suspended after any piece of a generation and resumed.
#[derive(Debug)]
pub struct SamplingSearch {
    rng: ChaCha8Rng,
    best: Candidate,
    distribution: ActionDistribution,
    /// Inner loss of the best plan before each generation and after the last.
    inner_losses: Vec<f32>,
    /// Number of generations before the best plan was found.
    best_iteration: usize,
    /// Number of complete generations.
    pub done: usize,
    /// Evaluated plans of the current generation.
    generation: Vec<Candidate>,
    /// Number of rollouts so far.
    pub rollouts: usize,
}

impl SamplingSearch {
    /// The first rollout: its plan is the mean of the first generation.
    pub fn begin(block: &mut impl PlanBlock, query: Query<'_>) -> Self {
        let source = if query.start.is_empty() { Actions::Proposed } else { Actions::Given };
        block.set_plan(1, 0, query.start);
        let loss = block.roll_out(&[query], source, Purpose::Loss)[0];
        let best = Candidate { actions: block.plan(1, 0), loss };
        let std = best.actions.iter().map(|action| vec![INITIAL_STD; action.len()]).collect();
        Self {
            rng: ChaCha8Rng::seed_from_u64(query.seed),
            distribution: ActionDistribution { mean: best.actions.clone(), std },
            best,
            inner_losses: vec![loss],
            best_iteration: 0,
            done: 0,
            generation: Vec::new(),
            rollouts: 1,
        }
    }

    /// A piece of a generation: at most a block's capacity of plans for each block and, after the last piece, the fit.
    pub fn advance<B: PlanBlock>(&mut self, blocks: &mut [B], query: Query<'_>, solver: Solver) {
        let (Solver::Cem(count) | Solver::Mppi(count) | Solver::Hybrid(count)) = solver else { return };
        let evaluated = self.generation.len();
        let piece = (count - evaluated).min(blocks[0].capacity() * blocks.len());
        self.generation.extend(self.distribution.sample(piece, &mut self.rng));
        evaluate(blocks, query, &mut self.generation[evaluated..]);
        self.rollouts += piece;
        if self.generation.len() == count {
            self.fit(&mut blocks[0], query, solver);
        }
    }

    /// Fits the distribution to a complete generation, and updates the best plan.
    fn fit(&mut self, block: &mut impl PlanBlock, query: Query<'_>, solver: Solver) {
        self.done += 1;

        let mut generation = std::mem::take(&mut self.generation);
        generation.sort_by(|a, b| a.loss.total_cmp(&b.loss));
        let mut best = generation[0].clone();
        match solver {
            Solver::Mppi(_) => self.distribution.mean = weighted_mean(&generation),
            _ => {
                let elites = (generation.len() / PLANS_PER_ELITE).max(2).min(generation.len());
                self.distribution = fit_elites(&generation[..elites]);
            }
        }

        if let Solver::Hybrid(_) = solver {
            block.set_plan(1, 0, &self.distribution.mean);
            block.roll_out(&[query], Actions::Given, Purpose::Gradient);
            block.descend(1);
            let loss = block.roll_out(&[query], Actions::Moved, Purpose::Loss)[0];
            let descended = Candidate { actions: block.plan(1, 0), loss };
            if descended.loss < best.loss {
                self.distribution.mean.clone_from(&descended.actions);
                best = descended;
            }
        }

        if best.loss < self.best.loss {
            (self.best, self.best_iteration) = (best, self.done);
        }
        self.inner_losses.push(self.best.loss);
    }

    /// The best plan of the complete generations.
    pub fn into_plan(self) -> Plan {
        Plan { actions: self.best.actions, inner_losses: self.inner_losses, iterations: self.best_iteration }
    }
}

/// Computes the losses of candidates, at most a block's capacity for each block.
fn evaluate<B: PlanBlock>(blocks: &mut [B], query: Query<'_>, candidates: &mut [Candidate]) {
    let size = blocks[0].capacity();
    if candidates.len() <= size {
        // One block suffices: waking another thread costs more than it saves.
        return evaluate_block(&mut blocks[0], query, candidates);
    }
    let parts = blocks.par_iter_mut().zip(candidates.par_chunks_mut(size));
    parts.for_each(|(block, candidates)| evaluate_block(block, query, candidates));
}

fn evaluate_block(block: &mut impl PlanBlock, query: Query<'_>, candidates: &mut [Candidate]) {
    let rows = candidates.len();
    for (r, candidate) in candidates.iter().enumerate() {
        block.set_plan(rows, r, &candidate.actions);
    }
    let losses = block.roll_out(&vec![query; rows], Actions::Given, Purpose::Loss);
    for (candidate, loss) in candidates.iter_mut().zip(losses) {
        candidate.loss = loss;
    }
}

impl ActionDistribution {
    /// `count` plans, clamped to [-1, 1], without losses.
    fn sample(&self, count: usize, rng: &mut ChaCha8Rng) -> Vec<Candidate> {
        let mut normal = |mean: f32, std: f32| {
            let noise: f32 = StandardNormal.sample(rng);
            (mean + std * noise).clamp(-1.0, 1.0)
        };
        let mut action = |(mean, std): (&Vec<f32>, &Vec<f32>)| {
            mean.iter().zip(std).map(|(mean, std)| normal(*mean, *std)).collect::<Vec<_>>()
        };
        let mut plan = || self.mean.iter().zip(&self.std).map(&mut action).collect();
        (0..count).map(|_| Candidate { actions: plan(), loss: f32::INFINITY }).collect()
    }
}

/// Mean and standard deviation of the elites.
fn fit_elites(elites: &[Candidate]) -> ActionDistribution {
    let share = 1.0 / elites.len() as f32;
    let mean = mean(elites.iter().map(|elite| (share, &elite.actions)));
    let std = |t: usize, i: usize| {
        let squares = elites.iter().map(|elite| (elite.actions[t][i] - mean[t][i]).powi(2));
        (share * squares.sum::<f32>()).sqrt().max(MIN_STD)
    };
    let std = (0..mean.len()).map(|t| (0..mean[t].len()).map(|i| std(t, i)).collect()).collect();
    ActionDistribution { mean, std }
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

/// The weighted sum of plans.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(actions: [f32; 2], loss: f32) -> Candidate {
        Candidate { actions: vec![vec![actions[0]], vec![actions[1]]], loss }
    }

    #[test]
    fn elites_are_fitted_by_mean_and_standard_deviation() {
        let fitted = fit_elites(&[candidate([0.5, 0.25], 0.0), candidate([-0.5, 0.25], 1.0)]);
        assert_eq!(fitted.mean, [[0.0], [0.25]]);
        assert_eq!(fitted.std, [[0.5], [MIN_STD]]);
    }

    /// A weight falls by the factor e per temperature, which is a tenth of the losses' standard deviation.
    #[test]
    fn the_weighted_mean_follows_the_best() {
        let mean = weighted_mean(&[candidate([1.0, 0.0], 0.0), candidate([0.0, 1.0], 2.0)]);
        let worse = (-20.0f32).exp();
        assert!((mean[1][0] - worse / (1.0 + worse)).abs() < 1e-12, "{mean:?}");
        assert!((mean[0][0] - 1.0).abs() < 1e-6, "{mean:?}");
        // Equal losses have equal weights.
        let mean = weighted_mean(&[candidate([1.0, 0.0], 3.0), candidate([0.0, 0.5], 3.0)]);
        assert_eq!(mean, [[0.5], [0.25]]);
    }

    #[test]
    fn samples_follow_the_distribution_within_the_actions_range() {
        let distribution = ActionDistribution { mean: vec![vec![0.2, 0.9]], std: vec![vec![0.1, 0.5]] };
        let sample = distribution.sample(4000, &mut ChaCha8Rng::seed_from_u64(1));
        let actions = |i: usize| sample.iter().map(move |candidate| candidate.actions[0][i]);
        let mean = actions(0).sum::<f32>() / 4000.0;
        let variance = actions(0).map(|a| (a - mean).powi(2)).sum::<f32>() / 4000.0;
        assert!((mean - 0.2).abs() < 0.01 && (variance.sqrt() - 0.1).abs() < 0.01, "{mean} {variance}");
        assert!(actions(1).all(|a| (-1.0..=1.0).contains(&a)) && actions(1).any(|a| a == 1.0));
    }
}
