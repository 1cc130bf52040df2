//! A layer of g_θ, plain or neuromodulated, and its four passes over a block of R samples.

use super::attenuated::Scratch;
use super::gated::{Gated, GatedGradient, GatedTape};
use super::linear::{Linear, LinearGradient, Weights};
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::Element;

/// Tapes and gradients are made by the layer that they are used with.
const MISMATCH: &str = "a layer is plain or gated, and so are its tape and its gradient";

/// y = a x + b, or y = (u(x) ⊙ a) x + v(x) ⊙ b.
#[derive(Debug)]
pub enum Dense<T> {
    Plain(Linear<T>),
    Gated(Box<Gated<T>>),
}

/// What a loss changes by when a layer's weights do.
#[derive(Debug)]
pub enum DenseGradient<T> {
    Plain(LinearGradient<T>),
    Gated(Box<GatedGradient<T>>),
}

/// What the passes over a layer leave for each other.
#[derive(Debug)]
pub struct Tape<T> {
    inputs: usize,
    outputs: usize,
    /// x and ẋ, `[2 R, inputs]`.
    x: AlignedVec<T>,
    /// ŷ and ȳ, `[2 R, outputs]`.
    y: AlignedVec<T>,
    gates: Option<GatedTape<T>>,
}

impl<T: Element> Tape<T> {
    /// x `[R, inputs]`, to be written before [`Dense::forward`].
    pub fn x(&mut self, rows: usize) -> &mut [T] {
        &mut self.x[..rows * self.inputs]
    }

    /// ẋ `[R, inputs]`, to be written before [`Dense::tangent`].
    pub fn x_dot(&mut self, rows: usize) -> &mut [T] {
        &mut self.x[rows * self.inputs..2 * rows * self.inputs]
    }

    /// ŷ `[R, outputs]`, to be written before [`Dense::adjoint`].
    pub fn y_hat(&mut self, rows: usize) -> &mut [T] {
        &mut self.y[..rows * self.outputs]
    }

    /// ȳ `[R, outputs]`, to be written before [`Dense::backward`].
    pub fn y_bar(&mut self, rows: usize) -> &mut [T] {
        &mut self.y[rows * self.outputs..2 * rows * self.outputs]
    }
}

impl<T: Element> DenseGradient<T> {
    /// Adds another of the same layer.
    pub fn add(&mut self, other: &Self) {
        match (self, other) {
            (Self::Plain(ours), Self::Plain(other)) => ours.add(other),
            (Self::Gated(ours), Self::Gated(other)) => ours.add(other),
            _ => unreachable!("{MISMATCH}"),
        }
    }
}

/// Which terms of Φ = ŷᵀy + ȳᵀẏ there are: the first, or both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    First,
    Second,
}

impl<T: Element> Dense<T> {
    /// The layer of this name in a checkpoint. Of its inputs the first are what a rectified linear unit `rectified`, none if that
    /// is 0.
    pub fn named(name: &str, rectified: usize, weights: &impl Weights<T>, gated: bool) -> Self {
        if gated {
            Self::Gated(Box::new(Gated::named(name, rectified, weights)))
        } else {
            Self::Plain(Linear::named(name, weights))
        }
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> DenseGradient<T> {
        match self {
            Self::Plain(linear) => DenseGradient::Plain(linear.gradient()),
            Self::Gated(gated) => DenseGradient::Gated(Box::new(gated.gradient())),
        }
    }

    /// A gradient by the names of the weights.
    pub fn in_weights(&self, name: &str, gradient: &DenseGradient<T>) -> Vec<(String, Vec<T>)> {
        match (self, gradient) {
            (Self::Plain(_), DenseGradient::Plain(gradient)) => gradient.in_weights(name),
            (Self::Gated(gated), DenseGradient::Gated(gradient)) => gated.in_weights(name, gradient),
            _ => unreachable!("{MISMATCH}"),
        }
    }

    /// A tape for blocks of up to R = `rows` samples.
    pub fn tape(&self, rows: usize) -> Tape<T> {
        let (inputs, outputs, gates) = match self {
            Self::Plain(linear) => (linear.inputs, linear.outputs, None),
            Self::Gated(gated) => (gated.inputs(), gated.outputs(), Some(gated.tape(rows))),
        };
        Tape { inputs, outputs, x: zeros(2 * rows * inputs), y: zeros(2 * rows * outputs), gates }
    }

    /// y `[R, outputs]` of the tape's x.
    pub fn forward(&self, rows: usize, tape: &mut Tape<T>, y: &mut [T]) {
        let x = &tape.x[..rows * tape.inputs];
        match (self, &mut tape.gates) {
            (Self::Plain(linear), _) => linear.forward(x, y),
            (Self::Gated(gated), Some(gates)) => gated.forward(rows, x, gates, y),
            _ => unreachable!("{MISMATCH}"),
        }
    }

    /// Adds to x̄ `[R, inputs]` what the tape's ȳ gives.
    pub fn backward(&self, rows: usize, tape: &mut Tape<T>, scratch: &mut Scratch<T>, x_bar: &mut [T]) {
        let (x, y_bar) = (&tape.x[..rows * tape.inputs], &tape.y[rows * tape.outputs..2 * rows * tape.outputs]);
        match (self, &mut tape.gates) {
            (Self::Plain(linear), _) => linear.add_backward(y_bar, x_bar),
            (Self::Gated(gated), Some(gates)) => gated.backward(rows, (x, y_bar), gates, scratch, x_bar),
            _ => unreachable!("{MISMATCH}"),
        }
    }

    /// ẏ `[R, outputs]` of the tape's ẋ.
    pub fn tangent(&self, rows: usize, tape: &mut Tape<T>, y_dot: &mut [T]) {
        let x = &tape.x[..2 * rows * tape.inputs];
        match (self, &mut tape.gates) {
            (Self::Plain(linear), _) => linear.tangent(&x[rows * tape.inputs..], y_dot),
            (Self::Gated(gated), Some(gates)) => gated.tangent(rows, x, gates, y_dot),
            _ => unreachable!("{MISMATCH}"),
        }
    }

    /// Adds to x̂ `[R, inputs]` and to the gradient what the tape's ŷ gives and, in the second order, its ẋ and ȳ.
    pub fn adjoint(
        &self,
        rows: usize,
        order: Order,
        tape: &mut Tape<T>,
        scratch: &mut Scratch<T>,
        x_hat: &mut [T],
        gradient: &mut DenseGradient<T>,
    ) {
        let stacked = if order == Order::First { rows } else { 2 * rows };
        let (x, y) = (&tape.x[..stacked * tape.inputs], &tape.y[..stacked * tape.outputs]);
        match (self, &mut tape.gates, gradient) {
            (Self::Plain(linear), _, DenseGradient::Plain(gradient)) => {
                linear.accumulate_all(rows, (x, y), gradient);
                linear.add_backward(&y[..rows * tape.outputs], x_hat);
            }
            (Self::Gated(gated), Some(gates), DenseGradient::Gated(gradient)) => {
                gated.adjoint(rows, (x, y), gates, scratch, x_hat, gradient);
            }
            _ => unreachable!("{MISMATCH}"),
        }
    }
}
