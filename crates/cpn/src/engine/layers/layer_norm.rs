//! Layer normalisation.

use super::linear::{LinearGradient, Weights};
use crate::engine::simd::buffer::zeros;
use crate::engine::simd::element::Element;

/// ε, added to the variance, as in libtorch.
const EPSILON: f64 = 1e-5;

/// Layer normalisation of rows `[Z]`: (x - mean) / sqrt(variance + ε) · weight + bias.
#[derive(Debug)]
pub struct LayerNorm<T> {
    weight: Vec<T>,
    bias: Vec<T>,
}

impl<T: Element> LayerNorm<T> {
    /// The layer of a name in a checkpoint.
    pub fn named(name: &str, weights: &impl Weights<T>) -> Self {
        Self { weight: weights.get(&format!("{name}.weight")), bias: weights.get(&format!("{name}.bias")) }
    }

    /// y `[R, Z]` of x `[R, Z]`.
    pub fn forward(&self, x: &[T]) -> Vec<T> {
        let normalise = |x: &[T]| {
            let (mean, scale) = moments(x);
            let scaled = x.iter().zip(self.weight.iter().zip(&self.bias));
            scaled.map(|(x, (weight, bias))| (*x - mean) * scale * *weight + *bias).collect::<Vec<_>>()
        };
        x.chunks_exact(self.weight.len()).flat_map(normalise).collect()
    }

    /// First-order backward pass, in place: replaces ŷ `[R, Z]` in `hat` by x̂, and adds to the weights' gradient.
    pub fn vjp(&self, x: &[T], hat: &mut [T], gradient: &mut LinearGradient<T>) {
        let latent = self.weight.len();
        let count = T::count(latent);
        for (x, hat) in x.chunks_exact(latent).zip(hat.chunks_exact_mut(latent)) {
            // Backward through weight and bias.
            let (mean, scale) = moments(x);
            let normal = |i: usize| (x[i] - mean) * scale;
            for (i, hat) in hat.iter_mut().enumerate() {
                gradient.weight[i] += *hat * normal(i);
                gradient.bias[i] += *hat;
                *hat = *hat * self.weight[i];
            }

            // Backward through the normalisation, which is invariant to shift and scale of x.
            let shift = hat.iter().copied().sum::<T>() / count;
            let stretch = hat.iter().enumerate().map(|(i, hat)| *hat * normal(i)).sum::<T>() / count;
            for (i, hat) in hat.iter_mut().enumerate() {
                *hat = (*hat - shift - normal(i) * stretch) * scale;
            }
        }
    }

    /// A zero gradient, weight and bias `[Z]`.
    pub fn gradient(&self) -> LinearGradient<T> {
        LinearGradient { weight: zeros(self.weight.len()), bias: zeros(self.bias.len()) }
    }
}

/// A row's mean, and 1 / sqrt(variance + ε).
fn moments<T: Element>(x: &[T]) -> (T, T) {
    let count = T::count(x.len());
    let mean = x.iter().copied().sum::<T>() / count;
    let variance = x.iter().map(|x| (*x - mean) * (*x - mean)).sum::<T>() / count;
    (mean, T::ONE / (variance + T::from_f64(EPSILON)).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_are_finite_differences() {
        let numbers = |count: usize, seed: usize| -> Vec<f64> {
            (0..count).map(|i| ((i * 7919 + seed * 104_729) % 9973) as f64 / 4986.5 - 1.0).collect()
        };
        let (latent, rows) = (5, 3);
        let [weight, bias, y_hat, x] =
            [(latent, 1), (latent, 2), (rows * latent, 3), (rows * latent, 4)].map(|(n, seed)| numbers(n, seed));
        let loss = |weight: &[f64], bias: &[f64], x: &[f64]| {
            let norm = LayerNorm { weight: weight.to_vec(), bias: bias.to_vec() };
            norm.forward(x).iter().zip(&y_hat).map(|(y, y_hat)| y * y_hat).sum::<f64>()
        };

        let norm = LayerNorm { weight: weight.clone(), bias: bias.clone() };
        let (mut x_hat, mut gradient) = (y_hat.clone(), norm.gradient());
        norm.vjp(&x, &mut x_hat, &mut gradient);

        let moved = |values: &[f64], i: usize, by: f64| {
            let mut values = values.to_vec();
            values[i] += by;
            values
        };
        let check = |ours: f64, f: &dyn Fn(f64) -> f64| {
            let expected = (f(1e-5) - f(-1e-5)) / 2e-5;
            assert!((ours - expected).abs() < 1e-7 * (1.0 + expected.abs()), "{ours} for {expected}");
        };

        for (i, x_hat) in x_hat.iter().enumerate() {
            check(*x_hat, &|by| loss(&weight, &bias, &moved(&x, i, by)));
        }
        for i in 0..latent {
            check(gradient.weight[i], &|by| loss(&moved(&weight, i, by), &bias, &x));
            check(gradient.bias[i], &|by| loss(&weight, &moved(&bias, i, by), &x));
        }
    }
}
