//! The encoder's last layer, from features to what is normalised.

use super::linear::{Linear, LinearGradient};
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::{Element, Operand};
use crate::encoder::Precision;

/// A linear layer that multiplies numbers as they are, or more coarsely.
#[derive(Debug)]
pub struct Readout<T: Element> {
    layer: Layer<T>,
    /// F.
    pub inputs: usize,
    /// Z.
    pub outputs: usize,
}

#[derive(Debug)]
enum Layer<T: Element> {
    Whole(Linear<T>),
    Half(Linear<T::Half, T>),
}

/// Room for both sides as factors, if they are not multiplied as they are.
#[derive(Debug)]
pub struct Room<T: Element> {
    whole: [AlignedVec<T>; 2],
    half: [AlignedVec<T::Half>; 2],
}

impl<T: Element> Room<T> {
    /// Empty.
    pub fn new() -> Self {
        Self { whole: [zeros(0), zeros(0)], half: [zeros(0), zeros(0)] }
    }
}

impl<T: Element> Readout<T> {
    /// Of weight `[Z, F]` and bias `[Z]`; odd sizes are always whole.
    pub fn new(weight: &[T], bias: Vec<T>, precision: Precision) -> Self {
        let (inputs, outputs) = (weight.len() / bias.len(), bias.len());
        let are_factors = [inputs, outputs].iter().all(|size| size.is_multiple_of(T::Half::PACK));
        let layer = if precision == Precision::Bfloat16 && are_factors {
            Layer::Half(Linear::new(weight, bias))
        } else {
            Layer::Whole(Linear::new(weight, bias))
        };
        Self { layer, inputs, outputs }
    }

    /// Features `[R, F]` to `[R, Z]`.
    pub fn forward(&self, x: &[T], y: &mut [T], room: &mut Room<T>) {
        match &self.layer {
            Layer::Whole(linear) => forward(linear, x, y, &mut room.whole),
            Layer::Half(linear) => forward(linear, x, y, &mut room.half),
        }
    }

    /// Adds to the gradient what ŷ gives, and writes x̂.
    pub fn adjoint(
        &self,
        (x, y_hat): (&[T], &[T]),
        x_hat: &mut [T],
        gradient: &mut LinearGradient<T>,
        room: &mut Room<T>,
    ) {
        match &self.layer {
            Layer::Whole(linear) => adjoint(linear, (x, y_hat), x_hat, gradient, &mut room.whole),
            Layer::Half(linear) => adjoint(linear, (x, y_hat), x_hat, gradient, &mut room.half),
        }
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> LinearGradient<T> {
        LinearGradient { weight: zeros(self.outputs * self.inputs), bias: zeros(self.outputs) }
    }
}

fn forward<T: Element, E: Operand<Sum = T>>(linear: &Linear<E, T>, x: &[T], y: &mut [T], [in_x, _]: &mut [AlignedVec<E>; 2]) {
    linear.forward(E::pack_along_k(x, in_x), y);
}

fn adjoint<T: Element, E: Operand<Sum = T>>(
    linear: &Linear<E, T>,
    (x, y_hat): (&[T], &[T]),
    x_hat: &mut [T],
    gradient: &mut LinearGradient<T>,
    [in_x, in_y]: &mut [AlignedVec<E>; 2],
) {
    let factors = (E::pack_row_pairs(x, linear.inputs, in_x), E::pack_row_pairs(y_hat, linear.outputs, in_y));
    linear.accumulate(factors, gradient);
    gradient.add_bias(y_hat);
    linear.backward(E::pack_along_k(y_hat, in_y), x_hat);
}
