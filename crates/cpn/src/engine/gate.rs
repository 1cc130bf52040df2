//! u_β or v_γ: two linear layers with a rectified linear unit between. The sigmoid at the end belongs to [what is
//! attenuated](super::attenuated), which runs over the same numbers anyway, and asks for them part by part.

use super::linear::{Linear, LinearGradient, Weights};
use super::rectified::{Open, rectify};
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::Element;
use super::sparse::{Part, Sparse, SparseGradient, Taker};

/// Weights of a part: 32 KB in float32.
const PART: usize = 1 << 13;

/// An attenuation network up to its sigmoid: s = a₂ h + b₂, h = relu(a₁ x + b₁), in a block of outputs for each number that is
/// attenuated for all of them.
#[derive(Debug)]
pub struct Gate<T> {
    hidden: Linear<T>,
    output: Sparse<T>,
}

/// What a loss changes by when a gate's weights do.
#[derive(Debug)]
pub struct GateGradient<T> {
    hidden: LinearGradient<T>,
    output: SparseGradient<T>,
}

/// What the passes over a gate leave for each other.
#[derive(Debug)]
pub struct GateTape<T> {
    /// K.
    hidden: usize,
    /// h and ḣ, `[2 R, K]`.
    h: AlignedVec<T>,
    /// Where h is not zero.
    open: Open,
    /// ĥ and h̄, `[2 R, K]`.
    h_adjoint: AlignedVec<T>,
}

impl<T: Element> Gate<T> {
    /// The gate of this name in a checkpoint, of blocks of O = `outputs`.
    pub fn named(name: &str, weights: &impl Weights<T>, outputs: usize) -> Self {
        let [weight, bias] = ["weight", "bias"].map(|part| weights.get(&format!("{name}.output.{part}")));
        Self { hidden: Linear::named(&format!("{name}.hidden"), weights), output: Sparse::new(&weight, &bias, outputs) }
    }

    pub fn gradient(&self) -> GateGradient<T> {
        GateGradient { hidden: self.hidden.gradient(), output: self.output.gradient() }
    }

    /// A gradient by the names of the weights.
    pub fn in_weights(&self, name: &str, gradient: &GateGradient<T>) -> Vec<(String, Vec<T>)> {
        let mut weights = gradient.hidden.in_weights(&format!("{name}.hidden"));
        let [weight, bias] = self.output.in_weights(&gradient.output);
        weights.extend([(format!("{name}.output.weight"), weight), (format!("{name}.output.bias"), bias)]);
        weights
    }

    pub fn tape(&self, rows: usize) -> GateTape<T> {
        let hidden = self.hidden.outputs;
        GateTape { hidden, h: zeros(2 * rows * hidden), open: Open::new(), h_adjoint: zeros(2 * rows * hidden) }
    }

    /// O'.
    pub fn width(&self) -> usize {
        self.output.width
    }

    /// Blocks whose weights stay in the nearest cache from one row to the next.
    pub fn part(&self) -> usize {
        (PART / (self.output.inputs * self.output.width)).max(1)
    }

    /// Before any [`Self::forward`]: leaves h of x `[R, inputs]` on the tape.
    pub fn enter(&self, rows: usize, x: &[T], tape: &mut GateTape<T>) {
        let h = &mut tape.h[..rows * tape.hidden];
        self.hidden.forward(x, h);
        rectify(h);
        tape.open.find(h, tape.hidden, tape.hidden, tape.hidden);
    }

    /// Gives s of a part, as it comes.
    pub fn forward(&self, part: &Part<'_>, tape: &GateTape<T>, taker: &mut impl Taker<T>) {
        self.output.forward(part, &tape.open, &tape.h, taker);
    }

    /// Before any [`Self::tangent`]: leaves ḣ of ẋ `[R, inputs]` on the tape.
    pub fn enter_tangent(&self, rows: usize, x_dot: &[T], tape: &mut GateTape<T>) {
        let h_dot = &mut tape.h[rows * tape.hidden..2 * rows * tape.hidden];
        self.hidden.tangent(x_dot, h_dot);
    }

    /// Gives ṡ of a part, as it comes.
    pub fn tangent(&self, part: &Part<'_>, tape: &GateTape<T>, taker: &mut impl Taker<T>) {
        self.output.tangent(part, &tape.open, &tape.h[part.rows * tape.hidden..], taker);
    }

    /// Adds up h̄ from s̄ of a part, the first of which begins anew.
    pub fn backward(&self, part: &Part<'_>, s_bar: &[T], sums: &mut AlignedVec<T>, tape: &mut GateTape<T>) {
        let size = part.rows * tape.hidden;
        self.output.backward(part, &tape.open, s_bar, sums, &mut tape.h_adjoint[size..2 * size]);
    }

    /// After every [`Self::backward`]: adds to x̄ what h̄ gives.
    pub fn leave_backward(&self, rows: usize, tape: &GateTape<T>, x_bar: &mut [T]) {
        let h_bar = &tape.h_adjoint[rows * tape.hidden..2 * rows * tape.hidden];
        self.hidden.add_backward(h_bar, x_bar);
    }

    /// Adds up ĥ, and adds to the gradient, what ŝ of a part and in the second order s̄ give.
    pub fn adjoint(
        &self,
        part: &Part<'_>,
        (s_hat, s_bar): (&[T], Option<&[T]>),
        sums: &mut AlignedVec<T>,
        tape: &mut GateTape<T>,
        gradient: &mut GateGradient<T>,
    ) {
        let size = part.rows * tape.hidden;
        let (h, h_dot) = tape.h.split_at(size);
        let second = s_bar.map(|s_bar| (h_dot, s_bar));
        self.output.accumulate(part, &tape.open, (h, s_hat), second, &mut gradient.output);
        self.output.backward(part, &tape.open, s_hat, sums, &mut tape.h_adjoint[..size]);
    }

    /// After every [`Self::adjoint`]: adds to x̂, and to the gradient, what ĥ and in the second order h̄ give; `x` holds x and
    /// likewise ẋ.
    pub fn leave_adjoint(
        &self,
        rows: usize,
        x: &[T],
        tape: &GateTape<T>,
        x_hat: &mut [T],
        gradient: &mut GateGradient<T>,
    ) {
        let stacked = x.len() / self.hidden.inputs;
        let h_adjoint = &tape.h_adjoint[..stacked * tape.hidden];
        self.hidden.add_backward(&h_adjoint[..rows * tape.hidden], x_hat);
        self.hidden.accumulate_all(rows, (x, h_adjoint), &mut gradient.hidden);
    }
}

impl<T: Element> GateGradient<T> {
    /// Adds another.
    pub fn add(&mut self, other: &Self) {
        self.hidden.add(&other.hidden);
        self.output.add(&other.output);
    }
}
