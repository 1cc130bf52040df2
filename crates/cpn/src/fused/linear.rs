//! The fully connected layer y = a x + b, and the four passes that everything here is made of.

use super::lanes::Lanes;
use super::matrix::{Matrix, Panels, accumulate_turned, multiply};
use super::real::Real;
use pulp::{Arch, Simd, WithSimd};

/// Weights by their names in a checkpoint.
pub trait Weights<T> {
    /// The weight of a name, which must be there, row by row.
    fn get(&self, name: &str) -> Vec<T>;
}

/// A layer's weights.
#[derive(Debug)]
pub struct Linear<T> {
    pub inputs: usize,
    pub outputs: usize,
    /// a, `[outputs, inputs]`.
    weight: Vec<T>,
    /// aᵀ, `[inputs, outputs]`: each product reads the one whose rows it runs along.
    transposed: Panels<T>,
    /// b, `[outputs]`.
    bias: Vec<T>,
}

/// What a loss changes by when the weights do.
#[derive(Debug, Clone)]
pub struct LinearGradient<T> {
    /// `[outputs, inputs]`.
    pub weight: Vec<T>,
    /// `[outputs]`.
    pub bias: Vec<T>,
}

impl<T: Real> Linear<T> {
    /// A layer of a `[outputs, inputs]` and b `[outputs]`.
    pub fn new(weight: Vec<T>, bias: Vec<T>) -> Self {
        let (inputs, outputs) = (weight.len() / bias.len(), bias.len());
        Self { inputs, outputs, transposed: Panels::transposed(&weight, inputs), weight, bias }
    }

    /// The layer of this name in a checkpoint.
    pub fn named(name: &str, weights: &impl Weights<T>) -> Self {
        Self::new(weights.get(&format!("{name}.weight")), weights.get(&format!("{name}.bias")))
    }

    /// a `[outputs, inputs]`.
    pub fn weight(&self) -> &[T] {
        &self.weight
    }

    /// b `[outputs]`.
    pub fn bias(&self) -> &[T] {
        &self.bias
    }

    /// y = a x + b: x `[R, inputs]` to y `[R, outputs]`.
    pub fn forward(&self, x: &[T], y: &mut [T]) {
        for row in y.chunks_exact_mut(self.outputs) {
            row.copy_from_slice(&self.bias);
        }
        multiply(true, y, x, self.transposed.matrix());
    }

    /// ẏ = a ẋ: how y changes as x does.
    pub fn tangent(&self, x_dot: &[T], y_dot: &mut [T]) {
        multiply(false, y_dot, x_dot, self.transposed.matrix());
    }

    /// x̄ += aᵀ ȳ: how a loss changes with x, from how it changes with y.
    pub fn backward(&self, y_bar: &[T], x_bar: &mut [T]) {
        multiply(true, x_bar, y_bar, Matrix::new(&self.weight, self.inputs));
    }

    /// Adds ∂Φ/∂a and ∂Φ/∂b to `gradient`, for Φ = ŷᵀy + ȳᵀẏ. `x` and `y` hold the R rows of x and ŷ and, in the second
    /// order, those of ẋ and ȳ after them.
    pub fn accumulate(&self, rows: usize, (x, y): (&[T], &[T]), gradient: &mut LinearGradient<T>) {
        accumulate_turned(&mut gradient.weight, y, Matrix::new(x, self.inputs));
        for row in y[..rows * self.outputs].chunks_exact(self.outputs) {
            add(&mut gradient.bias, row);
        }
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> LinearGradient<T> {
        LinearGradient { weight: vec![T::ZERO; self.weight.len()], bias: vec![T::ZERO; self.bias.len()] }
    }
}

impl<T> LinearGradient<T> {
    /// Both tensors, by their names in a checkpoint.
    pub fn tensors(&mut self, name: &str) -> Vec<(String, &mut Vec<T>)> {
        vec![(format!("{name}.weight"), &mut self.weight), (format!("{name}.bias"), &mut self.bias)]
    }
}

/// `sum += x`, element by element.
pub fn add<T: Real>(sum: &mut [T], x: &[T]) {
    Arch::new().dispatch(Sum { sum, x });
}

#[derive(Debug)]
struct Sum<'a, T> {
    sum: &'a mut [T],
    x: &'a [T],
}

impl<T: Real> WithSimd for Sum<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let count = Lanes::<S, T>::COUNT;
        for (sum, x) in self.sum.chunks_mut(count).zip(self.x.chunks(count)) {
            Lanes::load(simd, x).add_to(sum);
        }
    }
}
