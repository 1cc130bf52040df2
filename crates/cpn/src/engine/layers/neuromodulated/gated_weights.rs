//! Gated weights: weights attenuated for each sample, with the passes of their contribution y_o = Σ_i u_oi a_oi x_i to a layer's
//! outputs. The formulas are in [`layer`](super::layer).
//!
//! The weights of an input are contiguous. No pass needs them where x_i is zero after a rectified linear unit: ẋ_i is then zero
//! too, and x̄_i is masked by the unit.

use super::block_sparse::BlockRange;
use super::gate::{Gate, GateGradient, GateTape};
use super::kernels::{FirstOrderBackward, Forward, Jvp, SecondOrderBackward, Vjp, WeightsView};
use crate::engine::layers::linear::Weights;
use crate::engine::layers::passes::{Cotangent, Primal};
use crate::engine::layers::relu::ActiveSet;
use crate::engine::simd::buffer::{AlignedVec, resize, zeros};
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::add;
use pulp::Arch;
use std::ops::Range;

/// The weights and their gate.
#[derive(Debug)]
pub struct GatedWeights<T> {
    /// I, the number of inputs.
    pub inputs: usize,
    /// O, the number of outputs.
    pub outputs: usize,
    /// Number of leading inputs that are outputs of a rectified linear unit.
    rectified: usize,
    /// a, `[I, O']`: rows padded with zeros to whole registers.
    a: AlignedVec<T>,
    pub gate: Gate<T>,
}

/// Gradient of a loss in the weights and in the gate's weights.
#[derive(Debug)]
pub struct GatedWeightsGradient<T> {
    /// `[I, O']`.
    a: AlignedVec<T>,
    pub gate: GateGradient<T>,
}

/// Tape of the passes. u and ṡ, `[I, R, O']` in size, are stored range by range: `[R, blocks of the range, O']` for each.
#[derive(Debug)]
pub struct GatedWeightsTape<T> {
    /// Active inputs.
    active: ActiveSet,
    u: AlignedVec<T>,
    s_dot: AlignedVec<T>,
    pub gate: GateTape<T>,
}

/// Scratch memory of a pass, shared by the layers.
#[derive(Debug)]
pub struct Scratch<T> {
    /// ŝ and s̄ of a range.
    s: AlignedVec<T>,
    /// Partial sums of h̄ or ĥ over the ranges.
    sums: AlignedVec<T>,
}

/// Results of [`GatedWeights::double_backward`], which adds to both.
#[derive(Debug)]
pub struct Adjoints<'a, T> {
    /// x̂, `[R, I]`.
    pub x_hat: &'a mut [T],
    pub gradient: &'a mut GatedWeightsGradient<T>,
}

impl<T: Element> Scratch<T> {
    /// An empty scratch memory, which grows on use.
    pub fn new() -> Self {
        Self { s: zeros(0), sums: zeros(0) }
    }
}

impl<T: Element> GatedWeights<T> {
    /// Weights a `[O, I]` with the gate of a name in a checkpoint.
    pub fn new(a: &[T], outputs: usize, rectified: usize, gate: &str, weights: &impl Weights<T>) -> Self {
        let (inputs, gate) = (a.len() / outputs, Gate::named(gate, weights, outputs));
        let mut transposed = zeros(inputs * gate.width());
        for (i, line) in transposed.chunks_exact_mut(gate.width()).enumerate() {
            for (o, value) in line[..outputs].iter_mut().enumerate() {
                *value = a[o * inputs + i];
            }
        }
        Self { inputs, outputs, rectified, a: transposed, gate }
    }

    /// A zero gradient.
    pub fn gradient(&self) -> GatedWeightsGradient<T> {
        GatedWeightsGradient { a: zeros(self.a.len()), gate: self.gate.gradient() }
    }

    /// The gradient in a, `[O, I]`.
    pub fn in_a(&self, gradient: &GatedWeightsGradient<T>) -> Vec<T> {
        let indices = (0..self.outputs).flat_map(|o| (0..self.inputs).map(move |i| (o, i)));
        indices.map(|(o, i)| gradient.a[i * self.width() + o]).collect()
    }

    /// A tape for blocks of up to R = `rows` samples.
    pub fn tape(&self, rows: usize) -> GatedWeightsTape<T> {
        let size = rows * self.inputs * self.width();
        let gate = self.gate.tape(rows);
        GatedWeightsTape { active: ActiveSet::new(), u: zeros(size), s_dot: zeros(size), gate }
    }

    /// O', O rounded up to whole registers.
    fn width(&self) -> usize {
        self.gate.width()
    }

    /// View of the weights for the kernels.
    fn view(&self) -> WeightsView<'_, T> {
        WeightsView { inputs: self.inputs, outputs: self.outputs, width: self.width(), a: &self.a }
    }

    /// Adds the contribution of x to y; `gate_x` are the inputs of the gate.
    pub fn forward(&self, rows: usize, gate_x: &[T], x: &[T], tape: &mut GatedWeightsTape<T>, y: &mut [T]) {
        let GatedWeightsTape { active, u, gate, .. } = tape;
        active.scan(x, self.inputs, self.rectified, self.gate.range());
        self.gate.begin_forward(rows, gate_x, gate);

        for range in self.ranges(rows, active) {
            let u = &mut u[self.span(&range)];
            self.gate.forward(&range, gate, &mut Forward { weights: self.view(), range: &range, x, u, y });
        }
    }

    /// Adds the gradient in x, of ȳ, to x̄, except the part through the gate ([`Gate::end_vjp`]).
    pub fn vjp(
        &self,
        rows: usize,
        x: &[T],
        y_bar: &[T],
        tape: &mut GatedWeightsTape<T>,
        scratch: &mut Scratch<T>,
        x_bar: &mut [T],
    ) {
        let GatedWeightsTape { active, u, gate, .. } = tape;
        for range in self.ranges(rows, active) {
            let s_bar = resize(&mut scratch.s, rows * range.blocks.len() * self.width());
            let u = &u[self.span(&range)];
            Arch::new().dispatch(Vjp { weights: self.view(), range: &range, x, u, y_bar, x_bar, s_bar });
            self.gate.vjp(&range, s_bar, &mut scratch.sums, gate);
        }
    }

    /// Adds the contribution of x and ẋ to ẏ; `gate_x_dot` is the tangent of the gate's inputs.
    pub fn jvp(
        &self,
        rows: usize,
        gate_x_dot: &[T],
        Primal { x, x_dot }: Primal<'_, T>,
        tape: &mut GatedWeightsTape<T>,
        y_dot: &mut [T],
    ) {
        let GatedWeightsTape { active, u, s_dot, gate } = tape;
        self.gate.begin_jvp(rows, gate_x_dot, gate);

        for range in self.ranges(rows, active) {
            let span = self.span(&range);
            let (weights, u, s_dot) = (self.view(), &u[span.clone()], &mut s_dot[span]);
            self.gate.jvp(&range, gate, &mut Jvp { weights, range: &range, x, x_dot, u, s_dot, y_dot });
        }
    }

    /// Adds the gradient of Φ in x and in the weights, except the part of x̂ through the gate ([`Gate::end_double_backward`]).
    pub fn double_backward(
        &self,
        rows: usize,
        primal: Primal<'_, T>,
        cotangent: Cotangent<'_, T>,
        tape: &mut GatedWeightsTape<T>,
        scratch: &mut Scratch<T>,
        Adjoints { x_hat, gradient }: Adjoints<'_, T>,
    ) {
        let GatedWeightsTape { active, u, s_dot, gate } = tape;
        for range in self.ranges(rows, active) {
            let size = rows * range.blocks.len() * self.width();
            let (s_hat, s_bar) = resize(&mut scratch.s, 2 * size).split_at_mut(size);
            let span = self.span(&range);
            let (u, s_dot, in_a) = (&u[span.clone()], &s_dot[span], &mut *gradient.a);
            let (weights, range, x_hat) = (self.view(), &range, &mut *x_hat);

            let s_bar: &[T] = if cotangent.is_second_order() {
                Arch::new().dispatch(SecondOrderBackward {
                    weights,
                    range,
                    primal,
                    u,
                    s_dot,
                    cotangent,
                    x_hat,
                    s_hat: &mut *s_hat,
                    s_bar: &mut *s_bar,
                    in_a,
                });
                s_bar
            } else {
                let (x, y_hat, s_hat) = (primal.x, cotangent.y_hat, &mut *s_hat);
                Arch::new().dispatch(FirstOrderBackward { weights, range, x, u, y_hat, x_hat, s_hat, in_a });
                &[]
            };
            self.gate.double_backward(range, s_hat, s_bar, &mut scratch.sums, gate, &mut gradient.gate);
        }
    }

    /// Indices of a range in u and ṡ.
    fn span(&self, range: &BlockRange<'_>) -> Range<usize> {
        let size = range.rows * self.width();
        range.blocks.start * size..range.blocks.end * size
    }

    /// Ranges of inputs, in the order of the passes.
    fn ranges<'a>(&self, rows: usize, active: &'a ActiveSet) -> impl Iterator<Item = BlockRange<'a>> + use<'a, T> {
        let (inputs, count) = (self.inputs, self.gate.range());
        let range = move |first: usize| BlockRange { rows, blocks: first..inputs.min(first + count), active };
        (0..inputs).step_by(count).map(range)
    }
}

impl<T: Element> GatedWeightsGradient<T> {
    /// `self += other`.
    pub fn add(&mut self, other: &Self) {
        add(&mut self.a, &other.a);
        self.gate.add(&other.gate);
    }
}
