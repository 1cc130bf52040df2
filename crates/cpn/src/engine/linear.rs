//! The fully connected layer y = a x + b, and the four passes that everything here is made of.

use crate::engine::gemm::kernel::{Lhs, gemm};
use crate::engine::gemm::packing::{BLayout, PackedB};
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::{Element, Operand};
use crate::engine::simd::vector::add;

/// Weights by their names in a checkpoint.
pub trait Weights<T> {
    /// The weight of a name, which must be there, row by row.
    fn get(&self, name: &str) -> Vec<T>;
}

/// A layer's weights, as factors of its products, which T adds up: where these hold two numbers, both sizes are even.
#[derive(Debug)]
pub struct Linear<E, T = E> {
    pub inputs: usize,
    pub outputs: usize,
    /// a, `[outputs, inputs]`, across its rows.
    weight: AlignedVec<E>,
    /// aᵀ, `[inputs, outputs]`, along a's rows: each product reads the one whose rows it runs along.
    transposed: PackedB<E>,
    /// b, `[outputs]`.
    bias: Vec<T>,
}

/// What a loss changes by when the weights do.
#[derive(Debug, Clone)]
pub struct LinearGradient<T> {
    /// `[outputs, inputs]`; of a norm `[Z]`, as the other.
    pub weight: AlignedVec<T>,
    /// `[outputs]`.
    pub bias: AlignedVec<T>,
}

impl<T: Element, E: Operand<Sum = T>> Linear<E, T> {
    /// A layer of a `[outputs, inputs]` and b `[outputs]`.
    pub fn new(weight: &[T], bias: Vec<T>) -> Self {
        let (inputs, outputs) = (weight.len() / bias.len(), bias.len());
        let mut room = zeros(0);
        let transposed = PackedB::transposed(E::pack_along_k(weight, &mut room), inputs / E::PACK);
        let weight = AlignedVec::from_slice(0, E::pack_row_pairs(weight, inputs, &mut room));
        Self { inputs, outputs, weight, transposed, bias }
    }

    /// y = a x + b: x `[R, inputs]`, along its rows, to y `[R, outputs]`.
    pub fn forward(&self, x: &[E], y: &mut [T]) {
        for row in y.chunks_exact_mut(self.outputs) {
            row.copy_from_slice(&self.bias);
        }
        gemm(true, y, Lhs::Rows(x), self.transposed.layout());
    }

    /// ẏ = a ẋ: how y changes as x does.
    pub fn tangent(&self, x_dot: &[E], y_dot: &mut [T]) {
        gemm(false, y_dot, Lhs::Rows(x_dot), self.transposed.layout());
    }

    /// x̄ = aᵀ ȳ: how a loss changes with x, from how it changes with y.
    pub fn backward(&self, y_bar: &[E], x_bar: &mut [T]) {
        gemm(false, x_bar, Lhs::Rows(y_bar), BLayout::new(&self.weight, self.inputs));
    }

    /// The same, added to what is in x̄.
    pub fn add_backward(&self, y_bar: &[E], x_bar: &mut [T]) {
        gemm(true, x_bar, Lhs::Rows(y_bar), BLayout::new(&self.weight, self.inputs));
    }

    /// Adds ∂Φ/∂a to `gradient`, for Φ = ŷᵀy + ȳᵀẏ. `x` and `y` hold, across their rows, those of x and ŷ and, in the second
    /// order, those of ẋ and ȳ after them.
    pub fn accumulate(&self, (x, y): (&[E], &[E]), gradient: &mut LinearGradient<T>) {
        gemm(true, &mut gradient.weight, Lhs::Transposed(y), BLayout::new(x, self.inputs));
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> LinearGradient<T> {
        LinearGradient { weight: zeros(self.outputs * self.inputs), bias: zeros(self.outputs) }
    }
}

impl<T: Element> Linear<T> {
    /// The layer of this name in a checkpoint.
    pub fn named(name: &str, weights: &impl Weights<T>) -> Self {
        Self::new(&weights.get(&format!("{name}.weight")), weights.get(&format!("{name}.bias")))
    }

    /// [`Self::accumulate`], and ∂Φ/∂b, which the first R = `rows` of them make.
    pub fn accumulate_all(&self, rows: usize, (x, y): (&[T], &[T]), gradient: &mut LinearGradient<T>) {
        self.accumulate((x, y), gradient);
        gradient.add_bias(&y[..rows * self.outputs]);
    }
}

impl<T: Element> LinearGradient<T> {
    /// Adds ∂Φ/∂b, from the rows of ŷ.
    pub fn add_bias(&mut self, y: &[T]) {
        for row in y.chunks_exact(self.bias.len()) {
            add(&mut self.bias, row);
        }
    }

    /// Adds another.
    pub fn add(&mut self, other: &Self) {
        add(&mut self.weight, &other.weight);
        add(&mut self.bias, &other.bias);
    }

    /// By the names of the weights.
    pub fn in_weights(&self, name: &str) -> Vec<(String, Vec<T>)> {
        vec![(format!("{name}.weight"), self.weight.to_vec()), (format!("{name}.bias"), self.bias.to_vec())]
    }
}
