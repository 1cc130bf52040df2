//! Familiar goals: goals like those of training, recognised by the distance of their embedding to the nearest of these.

use crate::archive::{Tensor, Tensors};
use crate::config::ModelConfig;

/// Name of the embeddings in a checkpoint.
const GOALS: &str = "familiar.goals";
/// Name of the threshold in a checkpoint.
const DISTANCE: &str = "familiar.distance";
/// Fraction of the training goals that the threshold includes.
const QUANTILE: f64 = 0.95;

/// Embeddings of training goals with a threshold of distance: out-of-distribution detection by the nearest neighbour (Sun et al.,
/// 2022, arXiv 2204.06507).
#[derive(Debug, Clone, PartialEq)]
pub struct FamiliarGoals {
    /// Embeddings, `[N][Z]`.
    goals: Vec<Vec<f32>>,
    /// Largest Euclidean distance between a familiar goal and the nearest embedding.
    distance: f32,
}

impl FamiliarGoals {
    /// At most `count` of the embeddings of training goals, `[Z]` each and in the order of their episodes, evenly spread. The threshold
    /// is the 95 % quantile of the distances between an episode's goal and the nearest stored one of another episode; 0 for a single
    /// episode.
    pub fn new(embeddings: &[Vec<f32>], count: usize) -> Self {
        let (episodes, count) = (embeddings.len(), count.min(embeddings.len()));
        let stored: Vec<usize> = (0..count).map(|i| i * episodes / count).collect();
        let nearest = |episode: usize| {
            let others = stored.iter().filter(|other| **other != episode);
            others.map(|other| distance(&embeddings[episode], &embeddings[*other])).min_by(f32::total_cmp)
        };
        let mut distances: Vec<f32> = (0..episodes).filter_map(nearest).collect();
        distances.sort_by(f32::total_cmp);

        let included = (QUANTILE * distances.len() as f64).ceil() as usize;
        let distance = distances.get(included.saturating_sub(1)).copied().unwrap_or_default();
        Self { goals: stored.iter().map(|episode| embeddings[*episode].clone()).collect(), distance }
    }

    /// N, the number of stored embeddings.
    pub fn count(&self) -> usize {
        self.goals.len()
    }

    /// True if a goal's embedding, `[Z]`, is within the threshold of a stored one.
    pub fn contains(&self, x_g: &[f32]) -> bool {
        self.goals.iter().any(|goal| distance(goal, x_g) <= self.distance)
    }

    /// Names and shapes of the tensors in a checkpoint of a valid configuration; none without familiar goals.
    pub(crate) fn shapes(config: &ModelConfig) -> Vec<(String, Vec<usize>)> {
        let (count, latent) = (config.familiar_goals as usize, config.encoder.latent() as usize);
        let shapes = [(GOALS.to_owned(), vec![count, latent]), (DISTANCE.to_owned(), Vec::new())];
        shapes.into_iter().filter(|_| count > 0).collect()
    }

    /// The tensors in a checkpoint, by name.
    pub(crate) fn tensors(&self) -> [(String, Tensor); 2] {
        let shape = [self.goals.len(), self.goals[0].len()];
        [
            (GOALS.to_owned(), Tensor::new(&shape, &self.goals.concat())),
            (DISTANCE.to_owned(), Tensor::new(&[], &[self.distance])),
        ]
    }

    /// Moves the familiar goals out of a checkpoint's tensors, whose shapes and types have been checked; `None` if there are none.
    pub(crate) fn take(tensors: &mut Tensors) -> Option<Self> {
        let (goals, distance) = (tensors.remove(GOALS)?, tensors.remove(DISTANCE)?);
        let rows = goals.elements::<f32>()?;
        let goals = rows.chunks_exact(goals.shape()[1]).map(<[f32]>::to_vec).collect();
        Some(Self { goals, distance: distance.elements()?[0] })
    }
}

/// Euclidean distance between two embeddings, `[Z]` each.
fn distance(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Embeddings on a line, the neighbours at distance 1 but for the last.
    fn line(episodes: usize, last: f32) -> Vec<Vec<f32>> {
        let mut embeddings: Vec<_> = (0..episodes).map(|i| vec![i as f32, 0.0]).collect();
        embeddings[episodes - 1][0] += last;
        embeddings
    }

    #[test]
    fn goals_are_familiar_within_the_quantile_of_the_distances_between_training_goals() {
        // One of twenty is far from all others, and beyond the quantile.
        let familiar = FamiliarGoals::new(&line(20, 100.0), 20);
        assert_eq!((familiar.count(), familiar.distance), (20, 1.0));
        assert!(familiar.contains(&[3.0, 1.0]) && familiar.contains(&[119.0, -1.0]));
        assert!(!familiar.contains(&[3.0, 1.1]) && !familiar.contains(&[110.0, 0.0]));
        assert!(!familiar.contains(&[f32::NAN, 0.0]) && !familiar.contains(&[f32::MAX, 0.0]));

        // Of twelve it is within the quantile.
        assert_eq!(FamiliarGoals::new(&line(12, 100.0), 12).distance, 101.0);
    }

    #[test]
    fn stored_goals_are_evenly_spread_over_the_episodes() {
        let familiar = FamiliarGoals::new(&line(10, 0.0), 4);
        assert_eq!(familiar.goals.iter().map(|goal| goal[0]).collect::<Vec<_>>(), [0.0, 2.0, 5.0, 7.0]);
        // A stored goal is no neighbour of itself: the nearest others of 5 and 2 are 7 and 0.
        assert_eq!(familiar.distance, 2.0);
    }

    #[test]
    fn of_few_episodes_all_goals_are_stored() {
        assert_eq!(FamiliarGoals::new(&line(3, 0.0), 1024).count(), 3);
        let single = FamiliarGoals::new(&[vec![1.0, 2.0]], 1024);
        assert!(single.contains(&[1.0, 2.0]) && !single.contains(&[1.0, 2.1]));
    }
}
