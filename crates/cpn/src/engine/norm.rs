//! Layer normalisation.

use super::linear::{LinearGradient, Weights};
use crate::engine::simd::buffer::zeros;
use crate::engine::simd::element::Element;

/// What is added to the variance, as libtorch does.
const EPSILON: f64 = 1e-5;

/// Rows `[Z]` less their mean, by their deviation, then scaled and shifted.
#[derive(Debug)]
pub struct Norm<T> {
    weight: Vec<T>,
    bias: Vec<T>,
}

impl<T: Element> Norm<T> {
    /// The one of this name in a checkpoint.
    pub fn named(name: &str, weights: &impl Weights<T>) -> Self {
        Self { weight: weights.get(&format!("{name}.weight")), bias: weights.get(&format!("{name}.bias")) }
    }

    /// x `[R, Z]` to the same.
    pub fn forward(&self, x: &[T]) -> Vec<T> {
        let normalise = |x: &[T]| {
            let (mean, scale) = moments(x);
            let scaled = x.iter().zip(self.weight.iter().zip(&self.bias));
            scaled.map(|(x, (weight, bias))| (*x - mean) * scale * *weight + *bias).collect::<Vec<_>>()
        };
        x.chunks_exact(self.weight.len()).flat_map(normalise).collect()
    }

    /// Turns ŷ, `[R, Z]`, into x̂, and adds to the gradient what it gives.
    pub fn adjoint(&self, x: &[T], hat: &mut [T], gradient: &mut LinearGradient<T>) {
        let latent = self.weight.len();
        let count = T::count(latent);
        for (x, hat) in x.chunks_exact(latent).zip(hat.chunks_exact_mut(latent)) {
            let (mean, scale) = moments(x);
            let normal = |i: usize| (x[i] - mean) * scale;
            for (i, hat) in hat.iter_mut().enumerate() {
                gradient.weight[i] += *hat * normal(i);
                gradient.bias[i] += *hat;
                *hat = *hat * self.weight[i];
            }
            // Neither a shift nor a stretch of x changes anything.
            let shift = hat.iter().copied().sum::<T>() / count;
            let stretch = hat.iter().enumerate().map(|(i, hat)| *hat * normal(i)).sum::<T>() / count;
            for (i, hat) in hat.iter_mut().enumerate() {
                *hat = (*hat - shift - normal(i) * stretch) * scale;
            }
        }
    }

    /// A gradient of zeros, `[Z]` both.
    pub fn gradient(&self) -> LinearGradient<T> {
        LinearGradient { weight: zeros(self.weight.len()), bias: zeros(self.bias.len()) }
    }
}

/// A row's mean, and 1 by its deviation.
fn moments<T: Element>(x: &[T]) -> (T, T) {
    let count = T::count(x.len());
    let mean = x.iter().copied().sum::<T>() / count;
    let variance = x.iter().map(|x| (*x - mean) * (*x - mean)).sum::<T>() / count;
    (mean, T::ONE / (variance + T::from_f64(EPSILON)).sqrt())
}
