//! Projection of the encoder: its last linear layer, from features to the embedding before normalisation.

use super::linear::{Linear, LinearGradient};
use super::passes::Stacked;
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::{Element, Operand};
use crate::precision::Precision;

/// A linear layer in full or half precision.
#[derive(Debug)]
pub struct Projection<T: Element> {
    linear: PrecisionLinear<T>,
    /// F, the number of features.
    pub inputs: usize,
    /// Z, the size of the embedding.
    pub outputs: usize,
}

#[derive(Debug)]
enum PrecisionLinear<T: Element> {
    Full(Linear<T>),
    Half(Linear<T::Half, T>),
}

/// Workspace for both factors of a product as packed operands.
#[derive(Debug)]
pub struct ProjectionWorkspace<T: Element> {
    full: [AlignedVec<T>; 2],
    half: [AlignedVec<T::Half>; 2],
}

impl<T: Element> ProjectionWorkspace<T> {
    /// An empty workspace, which grows on use.
    pub fn new() -> Self {
        Self { full: [zeros(0), zeros(0)], half: [zeros(0), zeros(0)] }
    }
}

impl<T: Element> Projection<T> {
    /// A projection of weight `[Z, F]` and bias `[Z]`; always in full precision if F or Z is odd.
    pub fn new(weight: &[T], bias: Vec<T>, precision: Precision) -> Self {
        let (inputs, outputs) = (weight.len() / bias.len(), bias.len());
        let can_pack = [inputs, outputs].iter().all(|size| size.is_multiple_of(T::Half::PACK));
        let linear = if precision == Precision::Bfloat16 && can_pack {
            PrecisionLinear::Half(Linear::new(weight, bias))
        } else {
            PrecisionLinear::Full(Linear::new(weight, bias))
        };
        Self { linear, inputs, outputs }
    }

    /// y `[R, Z]` of features x `[R, F]`.
    pub fn forward(&self, x: &[T], y: &mut [T], workspace: &mut ProjectionWorkspace<T>) {
        match &self.linear {
            PrecisionLinear::Full(linear) => forward(linear, x, y, &mut workspace.full),
            PrecisionLinear::Half(linear) => forward(linear, x, y, &mut workspace.half),
        }
    }

    /// First-order backward pass from x `[R, F]` and ŷ `[R, Z]`: writes x̂, and adds to the weights' gradient.
    pub fn vjp(
        &self,
        x: &[T],
        y_hat: &[T],
        x_hat: &mut [T],
        gradient: &mut LinearGradient<T>,
        workspace: &mut ProjectionWorkspace<T>,
    ) {
        match &self.linear {
            PrecisionLinear::Full(linear) => vjp(linear, x, y_hat, x_hat, gradient, &mut workspace.full),
            PrecisionLinear::Half(linear) => vjp(linear, x, y_hat, x_hat, gradient, &mut workspace.half),
        }
    }

    /// A zero gradient.
    pub fn gradient(&self) -> LinearGradient<T> {
        LinearGradient { weight: zeros(self.outputs * self.inputs), bias: zeros(self.outputs) }
    }
}

fn forward<T: Element, E: Operand<Sum = T>>(
    linear: &Linear<E, T>,
    x: &[T],
    y: &mut [T],
    [packed_x, _]: &mut [AlignedVec<E>; 2],
) {
    linear.forward(E::pack_along_k(x, packed_x), y);
}

fn vjp<T: Element, E: Operand<Sum = T>>(
    linear: &Linear<E, T>,
    x: &[T],
    y_hat: &[T],
    x_hat: &mut [T],
    gradient: &mut LinearGradient<T>,
    [packed_x, packed_y]: &mut [AlignedVec<E>; 2],
) {
    let x = E::pack_row_pairs(x, linear.inputs, packed_x);
    let y = E::pack_row_pairs(y_hat, linear.outputs, packed_y);
    linear.accumulate(Stacked { x, y }, gradient);
    gradient.add_bias(y_hat);
    linear.vjp(E::pack_along_k(y_hat, packed_y), x_hat);
}
