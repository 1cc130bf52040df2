//! Adam optimiser (Kingma and Ba, 2015), in place on a model's weights.

use crate::archive::{Tensor, Tensors};
use crate::engine::layers::linear::Weights;
use crate::learner::LearnerError;
use std::collections::BTreeMap;

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-8;

/// Weights, with the first and second moments of their gradients.
#[derive(Debug)]
pub struct Adam {
    weights: BTreeMap<String, Weight>,
    /// Number of updates so far.
    steps: u32,
}

#[derive(Debug)]
struct Weight {
    shape: Vec<usize>,
    value: Vec<f32>,
    mean: Vec<f32>,
    square: Vec<f32>,
}

impl Adam {
    /// An optimiser of float32 weights.
    pub fn new(weights: &Tensors) -> Self {
        let weight = |(name, tensor): (&String, &Tensor)| {
            let value: Vec<f32> = tensor.elements().expect("weights are float32");
            let zeros = || vec![0.0; value.len()];
            let weight = Weight { shape: tensor.shape().to_vec(), mean: zeros(), square: zeros(), value };
            (name.clone(), weight)
        };
        Self { weights: weights.iter().map(weight).collect(), steps: 0 }
    }

    /// Updates the weights that have a gradient, clipped to the norm `max_norm`. Returns the norm over all weights before clipping.
    pub fn step(&mut self, gradient: &BTreeMap<String, Vec<f32>>, learning_rate: f64, max_norm: f64) -> f64 {
        let squares = gradient.values().map(|gradient| squared_norm(gradient));
        let norm = squares.sum::<f64>().sqrt();
        let scale = (max_norm / (norm + 1e-6)).min(1.0) as f32;

        self.steps += 1;
        let steps = self.steps.cast_signed();
        let bias_1 = 1.0 - f64::from(BETA_1).powi(steps);
        let bias_2 = (1.0 - f64::from(BETA_2).powi(steps)) as f32;
        let rate = (learning_rate / bias_1) as f32;
        for (name, Weight { value, mean, square, .. }) in &mut self.weights {
            let Some(gradient) = gradient.get(name) else { continue };
            let moments = mean.iter_mut().zip(square);
            for ((value, (mean, square)), gradient) in value.iter_mut().zip(moments).zip(gradient) {
                let gradient = gradient * scale;
                *mean = BETA_1 * *mean + (1.0 - BETA_1) * gradient;
                *square = BETA_2 * *square + (1.0 - BETA_2) * gradient * gradient;
                *value -= rate * *mean / ((*square / bias_2).sqrt() + EPSILON);
            }
        }
        norm
    }

    /// The current weights.
    pub fn weights(&self) -> Tensors {
        self.weights.iter().map(|(name, weight)| (name.clone(), Tensor::new(&weight.shape, &weight.value))).collect()
    }

    /// Weights and moments, as [`Learner::state`](crate::Learner::state).
    pub fn state(&self) -> Tensors {
        let parts = |(name, weight): (&String, &Weight)| {
            let Weight { shape, value, mean, square } = weight;
            [("weight", value), ("mean", mean), ("square", square)]
                .map(|(part, values)| (format!("{part}.{name}"), Tensor::new(shape, values)))
        };
        self.weights.iter().flat_map(parts).collect()
    }

    /// Restores an [`Adam::state`] after `steps` updates.
    ///
    /// # Errors
    /// The first tensor that is missing, or of another shape or type.
    pub fn restore(&mut self, state: &Tensors, steps: u32) -> Result<(), LearnerError> {
        for (name, Weight { shape, value, mean, square }) in &mut self.weights {
            for (part, values) in [("weight", value), ("mean", mean), ("square", square)] {
                let name = format!("{part}.{name}");
                let saved = state.get(&name).filter(|saved| saved.shape() == shape).and_then(Tensor::elements);
                *values = saved.ok_or_else(|| LearnerError::State { name, shape: shape.clone() })?;
            }
        }
        self.steps = steps;
        Ok(())
    }
}

impl Weights<f32> for Adam {
    fn get(&self, name: &str) -> Vec<f32> {
        self.weights[name].value.clone()
    }
}

/// The squared norm, by parallel sums that the compiler vectorises, in a fixed order.
fn squared_norm(gradient: &[f32]) -> f64 {
    let mut sums = [0.0; 16];
    for chunk in gradient.chunks(sums.len()) {
        for (sum, value) in sums.iter_mut().zip(chunk) {
            *sum += value * value;
        }
    }
    sums.into_iter().map(f64::from).sum()
}
