//! A layer of g_θ, plain or neuromodulated, and its four passes over a block of R samples.

use super::gate::GateGradient;
use super::gated::{Gated, GatesGradient, GatesTape, Scratch};
use super::lanes::{Aligned, zeros};
use super::linear::{Linear, LinearGradient, Weights};
use super::real::Real;

/// y = a x + b, or y = (u(x) ⊙ a) x + v(x) ⊙ b.
#[derive(Debug)]
pub enum Dense<T> {
    Plain(Linear<T>),
    Gated(Box<Gated<T>>),
}

/// What a loss changes by when a layer's weights do.
#[derive(Debug)]
pub struct DenseGradient<T> {
    pub linear: LinearGradient<T>,
    pub gates: Option<Box<GatesGradient<T>>>,
}

/// What the passes over a layer leave for each other.
#[derive(Debug)]
pub struct Tape<T> {
    inputs: usize,
    outputs: usize,
    /// x and ẋ, `[2 R, inputs]`.
    x: Aligned<T>,
    /// ŷ and ȳ, `[2 R, outputs]`.
    y: Aligned<T>,
    gates: Option<GatesTape<T>>,
}

impl<T: Real> Tape<T> {
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

impl<T: Real> DenseGradient<T> {
    /// Every tensor, by its name in a checkpoint.
    pub fn tensors(&mut self, name: &str) -> Vec<(String, &mut Aligned<T>)> {
        let mut tensors = self.linear.tensors(name);
        if let Some(gates) = &mut self.gates {
            for (gate, GateGradient { hidden, output }) in [("u", &mut gates.u), ("v", &mut gates.v)] {
                tensors.extend(hidden.tensors(&format!("{name}.{gate}.hidden")));
                tensors.extend(output.tensors(&format!("{name}.{gate}.output")));
            }
        }
        tensors
    }
}

/// Which terms of Φ = ŷᵀy + ȳᵀẏ there are: the first, or both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    First,
    Second,
}

impl<T: Real> Dense<T> {
    /// The layer of this name in a checkpoint.
    pub fn named(name: &str, weights: &impl Weights<T>, gated: bool) -> Self {
        if gated {
            Self::Gated(Box::new(Gated::named(name, weights)))
        } else {
            Self::Plain(Linear::named(name, weights))
        }
    }

    fn linear(&self) -> &Linear<T> {
        match self {
            Self::Plain(linear) => linear,
            Self::Gated(gated) => &gated.linear,
        }
    }

    fn gated(&self) -> Option<&Gated<T>> {
        match self {
            Self::Plain(_) => None,
            Self::Gated(gated) => Some(gated),
        }
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> DenseGradient<T> {
        DenseGradient { linear: self.linear().gradient(), gates: self.gated().map(|gated| Box::new(gated.gradient())) }
    }

    /// A tape for blocks of up to R = `rows` samples.
    pub fn tape(&self, rows: usize) -> Tape<T> {
        let Linear { inputs, outputs, .. } = *self.linear();
        let gates = self.gated().map(|gated| gated.tape(rows));
        Tape { inputs, outputs, x: zeros(2 * rows * inputs), y: zeros(2 * rows * outputs), gates }
    }

    /// y `[R, outputs]` of the tape's x.
    pub fn forward(&self, rows: usize, tape: &mut Tape<T>, y: &mut [T]) {
        let x = &tape.x[..rows * tape.inputs];
        match (self, &mut tape.gates) {
            (Self::Gated(gated), Some(gates)) => gated.forward(rows, x, gates, y),
            _ => self.linear().forward(x, y),
        }
    }

    /// Adds to x̄ `[R, inputs]` what the tape's ȳ gives.
    pub fn backward(&self, rows: usize, tape: &mut Tape<T>, scratch: &mut Scratch<T>, x_bar: &mut [T]) {
        let (x, y_bar) = (&tape.x[..rows * tape.inputs], &tape.y[rows * tape.outputs..2 * rows * tape.outputs]);
        match (self, &mut tape.gates) {
            (Self::Gated(gated), Some(gates)) => gated.backward(rows, (x, y_bar), gates, scratch, x_bar),
            _ => self.linear().backward(true, self.linear().all(), y_bar, x_bar),
        }
    }

    /// ẏ `[R, outputs]` of the tape's ẋ.
    pub fn tangent(&self, rows: usize, tape: &mut Tape<T>, y_dot: &mut [T]) {
        let x = &tape.x[..2 * rows * tape.inputs];
        match (self, &mut tape.gates) {
            (Self::Gated(gated), Some(gates)) => gated.tangent(rows, x, gates, y_dot),
            _ => self.linear().tangent(self.linear().all(), &x[rows * tape.inputs..], y_dot),
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
        match (self, &mut tape.gates, &mut gradient.gates) {
            (Self::Gated(gated), Some(gates), Some(in_gates)) => {
                gated.adjoint(rows, (x, y), gates, scratch, x_hat, (&mut gradient.linear, in_gates));
            }
            _ => {
                self.linear().accumulate_all(self.linear().all(), rows, (x, y), &mut gradient.linear);
                self.linear().backward(true, self.linear().all(), &y[..rows * tape.outputs], x_hat);
            }
        }
    }
}
