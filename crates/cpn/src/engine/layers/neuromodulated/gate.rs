//! Gate: an attenuation network u_β or v_γ, two linear layers with a rectified linear unit between them. The final sigmoid is part
//! of the [kernels of the gated weights](super::kernels), which consume the gate's outputs in registers, range by range.

use super::block_sparse::{BlockRange, BlockSparseGradient, BlockSparseLinear, Epilogue};
use crate::engine::layers::linear::{Linear, LinearGradient, Weights};
use crate::engine::layers::passes::{Cotangent, Primal, Stacked};
use crate::engine::layers::relu::{ActiveSet, relu};
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::Element;

/// Number of weights of a range of blocks: 32 KB in float32.
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

/// Tape of a gate: intermediates for later passes.
#[derive(Debug)]
pub struct GateTape<T> {
    /// K, the number of hidden units.
    hidden: usize,
    /// h and ḣ, `[2 R, K]`.
    h: AlignedVec<T>,
    /// Units with non-zero h.
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

    /// A zero gradient.
    pub fn gradient(&self) -> GateGradient<T> {
        GateGradient { hidden: self.hidden.gradient(), output: self.output.gradient() }
    }

    /// A gradient by the weights' names in a checkpoint.
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

    /// Number of blocks in a range, so that their weights stay in the nearest cache from row to row.
    pub fn range(&self) -> usize {
        (RANGE_WEIGHTS / (self.output.inputs * self.output.width)).max(1)
    }

    /// The hidden layer: records h of x `[R, inputs]` on the tape, for [`Self::forward`].
    pub fn begin_forward(&self, rows: usize, x: &[T], tape: &mut GateTape<T>) {
        let h = &mut tape.h[..rows * tape.hidden];
        self.hidden.forward(x, h);
        relu(h);
        tape.active.scan(h, tape.hidden, tape.hidden, tape.hidden);
    }

    /// s of a range; `epilogue` consumes it in registers.
    pub fn forward(&self, range: &BlockRange<'_>, tape: &GateTape<T>, epilogue: &mut impl Epilogue<T>) {
        self.output.forward(range, &tape.active, &tape.h, epilogue);
    }

    /// The hidden layer's tangent: records ḣ of ẋ `[R, inputs]` on the tape, for [`Self::jvp`]. The unit's mask is applied by the
    /// active set.
    pub fn begin_jvp(&self, rows: usize, x_dot: &[T], tape: &mut GateTape<T>) {
        let h_dot = &mut tape.h[rows * tape.hidden..2 * rows * tape.hidden];
        self.hidden.jvp(x_dot, h_dot);
    }

    /// ṡ of a range; `epilogue` consumes it in registers.
    pub fn jvp(&self, range: &BlockRange<'_>, tape: &GateTape<T>, epilogue: &mut impl Epilogue<T>) {
        self.output.jvp(range, &tape.active, &tape.h[range.rows * tape.hidden..], epilogue);
    }

    /// Adds the contribution of a range's s̄ to h̄; the first range resets h̄, and the last completes it.
    pub fn vjp(&self, range: &BlockRange<'_>, s_bar: &[T], sums: &mut AlignedVec<T>, tape: &mut GateTape<T>) {
        let size = range.rows * tape.hidden;
        self.output.vjp(range, &tape.active, s_bar, sums, &mut tape.h_adjoint[size..2 * size]);
    }

    /// Adds the hidden layer's gradient in its inputs, from h̄ after [`Self::vjp`] of all ranges, to x̄.
    pub fn end_vjp(&self, rows: usize, tape: &GateTape<T>, x_bar: &mut [T]) {
        let h_bar = &tape.h_adjoint[rows * tape.hidden..2 * rows * tape.hidden];
        self.hidden.add_vjp(h_bar, x_bar);
    }

    /// Adds the contribution of a range's ŝ to ĥ, and the gradient of Φ in the last layer's weights, of ŝ and, in the second order,
    /// s̄; in the first order `s_bar` is empty.
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

    /// Adds the hidden layer's gradient of Φ to x̂ and to the weights' gradient, from ĥ after [`Self::double_backward`] of all
    /// ranges and, in the second order, h̄. `x` holds x and, in the second order, ẋ.
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
