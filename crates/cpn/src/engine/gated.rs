//! The neuromodulated layer y = (u ⊙ a) x + v ⊙ b, where u = σ(s), s = u_β(x), and v likewise.
//!
//! With u' = u (1 - u) and u'' = u' (1 - 2 u), for one sample, output o and input i:
//!
//! - y_o = Σ_i u_oi a_oi x_i + v_o b_o
//! - ẏ_o = Σ_i a_oi (u'_oi ṡ_oi x_i + u_oi ẋ_i) + v'_o ṡ_o b_o
//! - x̄_i = Σ_o ȳ_o u_oi a_oi, and s̄_oi = ȳ_o a_oi u'_oi x_i, which goes on into the gate
//! - of Φ = ŷᵀy + ȳᵀẏ, with p_oi = ŷ_o x_i + ȳ_o ẋ_i and q_oi = ȳ_o ṡ_oi x_i:
//!   ∂Φ/∂a_oi = u_oi p_oi + u'_oi q_oi, ŝ_oi = a_oi (u'_oi p_oi + u''_oi q_oi), x̂_i = Σ_o a_oi (ŷ_o u_oi + ȳ_o u'_oi ṡ_oi)
//!
//! and for v the same with b in place of a and 1 in place of x: a bias is the weight of an input that is always 1.

use super::attenuated::{Attenuated, AttenuatedGradient, AttenuatedTape, Scratch};
use super::linear::Weights;
use crate::engine::simd::element::Element;

/// The layer's weights and biases.
#[derive(Debug)]
pub struct Gated<T> {
    a: Attenuated<T>,
    b: Attenuated<T>,
}

/// What a loss changes by when they do.
#[derive(Debug)]
pub struct GatedGradient<T> {
    a: AttenuatedGradient<T>,
    b: AttenuatedGradient<T>,
}

/// What the passes leave for each other.
#[derive(Debug)]
pub struct GatedTape<T> {
    a: AttenuatedTape<T>,
    b: AttenuatedTape<T>,
    /// 1 for each row: what b is multiplied by.
    ones: Vec<T>,
    /// How that changes.
    zeros: Vec<T>,
    /// And its adjoints, for which nobody asks.
    nothing: Vec<T>,
}

impl<T: Element> Gated<T> {
    /// The layer of this name in a checkpoint; a rectified linear unit left the first of its inputs.
    pub fn named(name: &str, rectified: usize, weights: &impl Weights<T>) -> Self {
        let [a, b] = ["weight", "bias"].map(|part| weights.get(&format!("{name}.{part}")));
        let attenuated = |values: &[T], rectified, gate: &str| {
            Attenuated::new(values, b.len(), rectified, &format!("{name}.{gate}"), weights)
        };
        Self { a: attenuated(&a, rectified, "u"), b: attenuated(&b, 0, "v") }
    }

    pub fn inputs(&self) -> usize {
        self.a.inputs
    }

    pub fn outputs(&self) -> usize {
        self.a.outputs
    }

    pub fn gradient(&self) -> GatedGradient<T> {
        GatedGradient { a: self.a.gradient(), b: self.b.gradient() }
    }

    /// A gradient by the names of the weights.
    pub fn in_weights(&self, name: &str, gradient: &GatedGradient<T>) -> Vec<(String, Vec<T>)> {
        let mut weights = vec![
            (format!("{name}.weight"), self.a.in_a(&gradient.a)),
            (format!("{name}.bias"), self.b.in_a(&gradient.b)),
        ];
        weights.extend(self.a.gate.in_weights(&format!("{name}.u"), &gradient.a.gate));
        weights.extend(self.b.gate.in_weights(&format!("{name}.v"), &gradient.b.gate));
        weights
    }

    pub fn tape(&self, rows: usize) -> GatedTape<T> {
        let [zeros, nothing] = [vec![T::ZERO; rows], vec![T::ZERO; rows]];
        GatedTape { a: self.a.tape(rows), b: self.b.tape(rows), ones: vec![T::ONE; rows], zeros, nothing }
    }

    /// y of x.
    pub fn forward(&self, rows: usize, x: &[T], tape: &mut GatedTape<T>, y: &mut [T]) {
        y.fill(T::ZERO);
        self.a.forward(rows, (x, x), &mut tape.a, y);
        self.b.forward(rows, (x, &tape.ones[..rows]), &mut tape.b, y);
    }

    /// Adds to x̄ what ȳ gives.
    pub fn backward(
        &self,
        rows: usize,
        (x, y_bar): (&[T], &[T]),
        tape: &mut GatedTape<T>,
        scratch: &mut Scratch<T>,
        x_bar: &mut [T],
    ) {
        self.a.backward(rows, (x, y_bar), &mut tape.a, scratch, x_bar);
        self.b.backward(rows, (&tape.ones, y_bar), &mut tape.b, scratch, &mut tape.nothing);
        self.a.gate.leave_backward(rows, &tape.a.gate, x_bar);
        self.b.gate.leave_backward(rows, &tape.b.gate, x_bar);
    }

    /// ẏ of ẋ; `x` holds x and ẋ.
    pub fn tangent(&self, rows: usize, x: &[T], tape: &mut GatedTape<T>, y_dot: &mut [T]) {
        let (x, x_dot) = x.split_at(rows * self.inputs());
        y_dot.fill(T::ZERO);
        self.a.tangent(rows, x_dot, (x, x_dot), &mut tape.a, y_dot);
        self.b.tangent(rows, x_dot, (&tape.ones, &tape.zeros), &mut tape.b, y_dot);
    }

    /// Adds to x̂ and to the gradient what ŷ gives. `x` and `y` hold x and ŷ and, in the second order, ẋ and ȳ after them.
    pub fn adjoint(
        &self,
        rows: usize,
        (x, y): (&[T], &[T]),
        tape: &mut GatedTape<T>,
        scratch: &mut Scratch<T>,
        x_hat: &mut [T],
        gradient: &mut GatedGradient<T>,
    ) {
        let ((x_now, x_dot), (y_hat, y_bar)) = (x.split_at(rows * self.inputs()), y.split_at(rows * self.outputs()));
        let is_second = !y_bar.is_empty();
        let second = is_second.then_some((x_dot, y_bar));
        self.a.adjoint(rows, (x_now, y_hat), second, &mut tape.a, scratch, (x_hat, &mut gradient.a));
        let second = is_second.then_some((&*tape.zeros, y_bar));
        let (ones, nothing) = (&tape.ones, &mut tape.nothing);
        self.b.adjoint(rows, (ones, y_hat), second, &mut tape.b, scratch, (nothing, &mut gradient.b));
        self.a.gate.leave_adjoint(rows, x, &tape.a.gate, x_hat, &mut gradient.a.gate);
        self.b.gate.leave_adjoint(rows, x, &tape.b.gate, x_hat, &mut gradient.b.gate);
    }
}

impl<T: Element> GatedGradient<T> {
    /// Adds another.
    pub fn add(&mut self, other: &Self) {
        self.a.add(&other.a);
        self.b.add(&other.b);
    }
}
