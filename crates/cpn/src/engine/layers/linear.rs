//! Fully connected layer y = a x + b, with the passes that all other layers build on.

use super::passes::Stacked;
use crate::engine::gemm::kernel::{Lhs, gemm};
use crate::engine::gemm::packing::{BLayout, PackedB};
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::{Element, Operand};
use crate::engine::simd::vector::add;

/// Source of weights, by name in a checkpoint.
pub trait Weights<T> {
    /// The weight of a name, in row-major order.
    ///
    /// # Panics
    /// If the name is unknown.
    fn get(&self, name: &str) -> Vec<T>;
}

/// A layer's weights as operands E of its products, accumulated in T. `inputs` and `outputs` are multiples of E's PACK.
#[derive(Debug)]
pub struct Linear<E, T = E> {
    pub inputs: usize,
    pub outputs: usize,
    /// a, `[outputs, inputs]`, packed across its rows.
    weight: AlignedVec<E>,
    /// aᵀ, `[inputs, outputs]`, packed along a's rows. Each product reads the layout that is contiguous in its direction.
    transposed: PackedB<E>,
    /// b, `[outputs]`.
    bias: Vec<T>,
}

/// Gradient of a loss in a layer's weights.
#[derive(Debug, Clone)]
pub struct LinearGradient<T> {
    /// `[outputs, inputs]`; of a layer normalisation `[Z]`, as the bias.
    pub weight: AlignedVec<T>,
    /// `[outputs]`.
    pub bias: AlignedVec<T>,
}

impl<T: Element, E: Operand<Sum = T>> Linear<E, T> {
    /// A layer of weight a, `[outputs, inputs]`, and bias b, `[outputs]`.
    pub fn new(weight: &[T], bias: Vec<T>) -> Self {
        let (inputs, outputs) = (weight.len() / bias.len(), bias.len());
        let mut workspace = zeros(0);
        let transposed = PackedB::transposed(E::pack_along_k(weight, &mut workspace), inputs / E::PACK);
        let weight = AlignedVec::from_slice(0, E::pack_row_pairs(weight, inputs, &mut workspace));
        Self { inputs, outputs, weight, transposed, bias }
    }

    /// y = a x + b, `[R, outputs]`, of x `[R, inputs]`, packed along its rows.
    pub fn forward(&self, x: &[E], y: &mut [T]) {
        for row in y.chunks_exact_mut(self.outputs) {
            row.copy_from_slice(&self.bias);
        }
        gemm(true, y, Lhs::Rows(x), self.transposed.layout());
    }

    /// The tangent ẏ = a ẋ.
    pub fn jvp(&self, x_dot: &[E], y_dot: &mut [T]) {
        gemm(false, y_dot, Lhs::Rows(x_dot), self.transposed.layout());
    }

    /// The gradient in the inputs, x̄ = aᵀ ȳ.
    pub fn vjp(&self, y_bar: &[E], x_bar: &mut [T]) {
        gemm(false, x_bar, Lhs::Rows(y_bar), BLayout::new(&self.weight, self.inputs));
    }

    /// [`Self::vjp`], added to x̄.
    pub fn add_vjp(&self, y_bar: &[E], x_bar: &mut [T]) {
        gemm(true, x_bar, Lhs::Rows(y_bar), BLayout::new(&self.weight, self.inputs));
    }

    /// Adds ∂Φ/∂a, for Φ = ŷᵀy + ȳᵀẏ, to `gradient`.
    pub fn accumulate(&self, stacked: Stacked<'_, E>, gradient: &mut LinearGradient<T>) {
        gemm(true, &mut gradient.weight, Lhs::Transposed(stacked.y), BLayout::new(stacked.x, self.inputs));
    }

    /// A zero gradient.
    pub fn gradient(&self) -> LinearGradient<T> {
        LinearGradient { weight: zeros(self.outputs * self.inputs), bias: zeros(self.outputs) }
    }
}

impl<T: Element> Linear<T> {
    /// The layer of a name in a checkpoint.
    pub fn named(name: &str, weights: &impl Weights<T>) -> Self {
        Self::new(&weights.get(&format!("{name}.weight")), weights.get(&format!("{name}.bias")))
    }

    /// [`Self::accumulate`], and ∂Φ/∂b from ŷ, the first R = `rows` of the stacked rows.
    pub fn accumulate_all(&self, rows: usize, stacked: Stacked<'_, T>, gradient: &mut LinearGradient<T>) {
        self.accumulate(stacked, gradient);
        gradient.add_bias(&stacked.y[..rows * self.outputs]);
    }
}

impl<T: Element> LinearGradient<T> {
    /// Adds ∂Φ/∂b, the sum over the rows of ŷ.
    pub fn add_bias(&mut self, y_hat: &[T]) {
        for row in y_hat.chunks_exact(self.bias.len()) {
            add(&mut self.bias, row);
        }
    }

    /// `self += other`.
    pub fn add(&mut self, other: &Self) {
        add(&mut self.weight, &other.weight);
        add(&mut self.bias, &other.bias);
    }

    /// The gradient by the weights' names in a checkpoint.
    pub fn in_weights(&self, name: &str) -> Vec<(String, Vec<T>)> {
        vec![(format!("{name}.weight"), self.weight.to_vec()), (format!("{name}.bias"), self.bias.to_vec())]
    }
}
