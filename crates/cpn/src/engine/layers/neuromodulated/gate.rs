//! The attenuation networks u_β and v_γ: two linear layers with a rectified linear unit between. The sigmoid at the end belongs to
//! the [kernels of the gated weights](super::kernels), which run over the same numbers anyway; they take the gate's outputs range
//! by range.

use super::block_sparse::{BlockRange, BlockSparseGradient, BlockSparseLinear, Epilogue};
use crate::engine::layers::linear::{Linear, LinearGradient, Weights};
use crate::engine::layers::passes::{Cotangent, Primal, Stacked};
use crate::engine::layers::relu::{ActiveSet, relu};
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::Element;

/// Weights of a range of blocks: 32 KB in float32.
const RANGE_WEIGHTS: usize = 1 << 13;

/// An attenuation network up to its sigmoid: s = a₂ h + b₂, h = relu(a₁ x + b₁), in a block of O outputs for each input of the
/// gated layer.
#[derive(Debug)]
pub struct Gate<T> {
    hidden: Linear<T>,
    output: BlockSparseLinear<T>,
}

/// Gradient of a loss in a gate's weights.
#[derive(Debug)]
pub struct GateGradient<T> {
    hidden: LinearGradient<T>,
    output: BlockSparseGradient<T>,
}

/// Tape of a gate: intermediates that its passes leave for each other.
#[derive(Debug)]
pub struct GateTape<T> {
    /// K.
    hidden: usize,
    /// h and ḣ, `[2 R, K]`.
    h: AlignedVec<T>,
    /// Units whose h is not zero.
    active: ActiveSet,
    /// ĥ and h̄, `[2 R, K]`.
    h_adjoint: AlignedVec<T>,
}

impl<T: Element> Gate<T> {
    /// The gate of a name in a checkpoint, in blocks of O = `outputs`.
    pub fn named(name: &str, weights: &impl Weights<T>, outputs: usize) -> Self {
        let [weight, bias] = ["weight", "bias"].map(|part| weights.get(&format!("{name}.output.{part}")));
        let output = BlockSparseLinear::new(&weight, &bias, outputs);
        Self { hidden: Linear::named(&format!("{name}.hidden"), weights), output }
    }

    /// A gradient of zeros.
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

    /// A tape for blocks of up to R = `rows` samples.
    pub fn tape(&self, rows: usize) -> GateTape<T> {
        let hidden = self.hidden.outputs;
        let [h, h_adjoint] = [(); 2].map(|()| zeros(2 * rows * hidden));
        GateTape { hidden, h, active: ActiveSet::new(), h_adjoint }
    }

    /// O', O rounded up to whole registers.
    pub fn width(&self) -> usize {
        self.output.width
    }

    /// Blocks of a range: as many as have weights that stay in the nearest cache from one row to the next.
    pub fn range(&self) -> usize {
        (RANGE_WEIGHTS / (self.output.inputs * self.output.width)).max(1)
    }

    /// The hidden layer: h of x `[R, inputs]`, left on the tape before any [`Self::forward`].
    pub fn begin_forward(&self, rows: usize, x: &[T], tape: &mut GateTape<T>) {
        let h = &mut tape.h[..rows * tape.hidden];
        self.hidden.forward(x, h);
        relu(h);
        tape.active.scan(h, tape.hidden, tape.hidden, tape.hidden);
    }

    /// s of a range, passed to `epilogue` while it is in registers.
    pub fn forward(&self, range: &BlockRange<'_>, tape: &GateTape<T>, epilogue: &mut impl Epilogue<T>) {
        self.output.forward(range, &tape.active, &tape.h, epilogue);
    }

    /// The hidden layer's tangent: ḣ of ẋ `[R, inputs]`, left on the tape before any [`Self::jvp`].
    pub fn begin_jvp(&self, rows: usize, x_dot: &[T], tape: &mut GateTape<T>) {
        let h_dot = &mut tape.h[rows * tape.hidden..2 * rows * tape.hidden];
        self.hidden.jvp(x_dot, h_dot);
    }

    /// ṡ of a range, passed to `epilogue` while it is in registers.
    pub fn jvp(&self, range: &BlockRange<'_>, tape: &GateTape<T>, epilogue: &mut impl Epilogue<T>) {
        self.output.jvp(range, &tape.active, &tape.h[range.rows * tape.hidden..], epilogue);
    }

    /// h̄, summed over the ranges, from s̄ of one; the first range begins anew.
    pub fn vjp(&self, range: &BlockRange<'_>, s_bar: &[T], sums: &mut AlignedVec<T>, tape: &mut GateTape<T>) {
        let size = range.rows * tape.hidden;
        self.output.vjp(range, &tape.active, s_bar, sums, &mut tape.h_adjoint[size..2 * size]);
    }

    /// The hidden layer's gradient in its inputs, from h̄ after every [`Self::vjp`], added to x̄.
    pub fn end_vjp(&self, rows: usize, tape: &GateTape<T>, x_bar: &mut [T]) {
        let h_bar = &tape.h_adjoint[rows * tape.hidden..2 * rows * tape.hidden];
        self.hidden.add_vjp(h_bar, x_bar);
    }

    /// ĥ, summed over the ranges, and the gradient of Φ in the last layer's weights, from ŝ of a range and, in the second order,
    /// s̄; otherwise `s_bar` is empty.
    pub fn double_backward(
        &self,
        range: &BlockRange<'_>,
        s_hat: &[T],
        s_bar: &[T],
        sums: &mut AlignedVec<T>,
        tape: &mut GateTape<T>,
        gradient: &mut GateGradient<T>,
    ) {
        let size = range.rows * tape.hidden;
        let (x, x_dot) = tape.h.split_at(size);
        let (primal, cotangent) = (Primal { x, x_dot }, Cotangent { y_hat: s_hat, y_bar: s_bar });
        self.output.accumulate(range, &tape.active, primal, cotangent, &mut gradient.output);
        self.output.vjp(range, &tape.active, s_hat, sums, &mut tape.h_adjoint[..size]);
    }

    /// The hidden layer's gradient of Φ, from ĥ and, in the second order, h̄ after every [`Self::double_backward`]: added to x̂ and
    /// to the weights' gradient. `x` holds x and, in the second order, ẋ.
    pub fn end_double_backward(
        &self,
        rows: usize,
        x: &[T],
        tape: &GateTape<T>,
        x_hat: &mut [T],
        gradient: &mut GateGradient<T>,
    ) {
        let stacked_rows = x.len() / self.hidden.inputs;
        let h_adjoint = &tape.h_adjoint[..stacked_rows * tape.hidden];
        self.hidden.add_vjp(&h_adjoint[..rows * tape.hidden], x_hat);
        self.hidden.accumulate_all(rows, Stacked { x, y: h_adjoint }, &mut gradient.hidden);
    }
}

impl<T: Element> GateGradient<T> {
    /// `self += other`.
    pub fn add(&mut self, other: &Self) {
        self.hidden.add(&other.hidden);
        self.output.add(&other.output);
    }
}
