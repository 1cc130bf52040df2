//! Fully connected layer of g_θ, plain or neuromodulated, and its four passes over a block of R samples.

use super::linear::{Linear, LinearGradient, Weights};
use super::passes::{Order, Stacked};
use crate::engine::layers::neuromodulated::gated_weights::Scratch;
use crate::engine::layers::neuromodulated::layer::{Neuromodulated, NeuromodulatedGradient, NeuromodulatedTape};
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::Element;

/// Text of the panic for a tape or a gradient of another layer.
const MISMATCH: &str = "a layer is plain or neuromodulated, and so are its tape and its gradient";

/// y = a x + b, or y = (u(x) ⊙ a) x + v(x) ⊙ b.
#[derive(Debug)]
pub enum Dense<T> {
    Plain(Linear<T>),
    Neuromodulated(Box<Neuromodulated<T>>),
}

/// Gradient of a loss in a layer's weights.
#[derive(Debug)]
pub enum DenseGradient<T> {
    Plain(LinearGradient<T>),
    Neuromodulated(Box<NeuromodulatedGradient<T>>),
}

/// Tape of a layer: arguments of its passes, and intermediates for later passes.
#[derive(Debug)]
pub struct LayerTape<T> {
    inputs: usize,
    outputs: usize,
    /// x and ẋ, `[2 R, inputs]`.
    x: AlignedVec<T>,
    /// ŷ and ȳ, `[2 R, outputs]`.
    y: AlignedVec<T>,
    gates: Option<NeuromodulatedTape<T>>,
}

impl<T: Element> LayerTape<T> {
    /// x `[R, inputs]`, to be written before [`Dense::forward`].
    pub fn x(&mut self, rows: usize) -> &mut [T] {
        &mut self.x[..rows * self.inputs]
    }

    /// ẋ `[R, inputs]`, to be written before [`Dense::jvp`].
    pub fn x_dot(&mut self, rows: usize) -> &mut [T] {
        &mut self.x[rows * self.inputs..2 * rows * self.inputs]
    }

    /// ŷ `[R, outputs]`, to be written before [`Dense::double_backward`].
    pub fn y_hat(&mut self, rows: usize) -> &mut [T] {
        &mut self.y[..rows * self.outputs]
    }

    /// ȳ `[R, outputs]`, to be written before [`Dense::vjp`].
    pub fn y_bar(&mut self, rows: usize) -> &mut [T] {
        &mut self.y[rows * self.outputs..2 * rows * self.outputs]
    }
}

impl<T: Element> DenseGradient<T> {
    /// `self += other`, of the same layer.
    pub fn add(&mut self, other: &Self) {
        match (self, other) {
            (Self::Plain(ours), Self::Plain(other)) => ours.add(other),
            (Self::Neuromodulated(ours), Self::Neuromodulated(other)) => ours.add(other),
            _ => unreachable!("{MISMATCH}"),
        }
    }
}

impl<T: Element> Dense<T> {
    /// The layer of a name in a checkpoint. The first `rectified` of its inputs are outputs of a rectified linear unit.
    pub fn named(name: &str, rectified: usize, weights: &impl Weights<T>, is_neuromodulated: bool) -> Self {
        if is_neuromodulated {
            Self::Neuromodulated(Box::new(Neuromodulated::named(name, rectified, weights)))
        } else {
            Self::Plain(Linear::named(name, weights))
        }
    }

    /// A zero gradient.
    pub fn gradient(&self) -> DenseGradient<T> {
        match self {
            Self::Plain(linear) => DenseGradient::Plain(linear.gradient()),
            Self::Neuromodulated(layer) => DenseGradient::Neuromodulated(Box::new(layer.gradient())),
        }
    }

    /// A gradient by the weights' names in a checkpoint.
    pub fn in_weights(&self, name: &str, gradient: &DenseGradient<T>) -> Vec<(String, Vec<T>)> {
        match (self, gradient) {
            (Self::Plain(_), DenseGradient::Plain(gradient)) => gradient.in_weights(name),
            (Self::Neuromodulated(layer), DenseGradient::Neuromodulated(gradient)) => layer.in_weights(name, gradient),
            _ => unreachable!("{MISMATCH}"),
        }
    }

    /// A tape for blocks of up to R = `rows` samples.
    pub fn tape(&self, rows: usize) -> LayerTape<T> {
        let (inputs, outputs, gates) = match self {
            Self::Plain(linear) => (linear.inputs, linear.outputs, None),
            Self::Neuromodulated(layer) => (layer.inputs(), layer.outputs(), Some(layer.tape(rows))),
        };
        LayerTape { inputs, outputs, x: zeros(2 * rows * inputs), y: zeros(2 * rows * outputs), gates }
    }

    /// The outputs y `[R, outputs]` of the tape's x.
    pub fn forward(&self, rows: usize, tape: &mut LayerTape<T>, y: &mut [T]) {
        let x = &tape.x[..rows * tape.inputs];
        match (self, &mut tape.gates) {
            (Self::Plain(linear), _) => linear.forward(x, y),
            (Self::Neuromodulated(layer), Some(gates)) => layer.forward(rows, x, gates, y),
            _ => unreachable!("{MISMATCH}"),
        }
    }

    /// Adds the gradient in the inputs, of the tape's ȳ, to x̄ `[R, inputs]`.
    pub fn vjp(&self, rows: usize, tape: &mut LayerTape<T>, scratch: &mut Scratch<T>, x_bar: &mut [T]) {
        let (x, y_bar) = (&tape.x[..rows * tape.inputs], &tape.y[rows * tape.outputs..2 * rows * tape.outputs]);
        match (self, &mut tape.gates) {
            (Self::Plain(linear), _) => linear.add_vjp(y_bar, x_bar),
            (Self::Neuromodulated(layer), Some(gates)) => layer.vjp(rows, x, y_bar, gates, scratch, x_bar),
            _ => unreachable!("{MISMATCH}"),
        }
    }

    /// The tangent ẏ `[R, outputs]` of the tape's ẋ.
    pub fn jvp(&self, rows: usize, tape: &mut LayerTape<T>, y_dot: &mut [T]) {
        let x = &tape.x[..2 * rows * tape.inputs];
        match (self, &mut tape.gates) {
            (Self::Plain(linear), _) => linear.jvp(&x[rows * tape.inputs..], y_dot),
            (Self::Neuromodulated(layer), Some(gates)) => layer.jvp(rows, x, gates, y_dot),
            _ => unreachable!("{MISMATCH}"),
        }
    }

    /// Adds the gradient of Φ in inputs and weights, from the tape's ŷ and, in the second order, its ẋ and ȳ, to x̂ `[R, inputs]`
    /// and `gradient`.
    pub fn double_backward(
        &self,
        rows: usize,
        order: Order,
        tape: &mut LayerTape<T>,
        scratch: &mut Scratch<T>,
        x_hat: &mut [T],
        gradient: &mut DenseGradient<T>,
    ) {
        let stacked_rows = if order == Order::First { rows } else { 2 * rows };
        let stacked = Stacked { x: &tape.x[..stacked_rows * tape.inputs], y: &tape.y[..stacked_rows * tape.outputs] };
        match (self, &mut tape.gates, gradient) {
            (Self::Plain(linear), _, DenseGradient::Plain(gradient)) => {
                linear.accumulate_all(rows, stacked, gradient);
                linear.add_vjp(&stacked.y[..rows * tape.outputs], x_hat);
            }
            (Self::Neuromodulated(layer), Some(gates), DenseGradient::Neuromodulated(gradient)) => {
                layer.double_backward(rows, stacked, gates, scratch, x_hat, gradient);
            }
            _ => unreachable!("{MISMATCH}"),
        }
    }
}
