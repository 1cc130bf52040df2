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
//! and for v the same with b in place of a and 1 in place of x.

use super::gate::{Gate, GateGradient, GateTape};
use super::lanes::{Aligned, grown, zeros};
use super::linear::{Linear, LinearGradient, Weights};
use super::modulation::{Backward, FirstAdjoint, Forward, SecondAdjoint, Sigmoid, Tangent};
use super::real::Real;
use pulp::Arch;
use std::ops::Range;

/// Numbers of a part: 32 KB in float32.
const PART: usize = 1 << 13;

/// The layer's weights.
#[derive(Debug)]
pub struct Gated<T> {
    pub linear: Linear<T>,
    u: Gate<T>,
    v: Gate<T>,
}

/// What a loss changes by when the gates' weights do.
#[derive(Debug)]
pub struct GatesGradient<T> {
    pub u: GateGradient<T>,
    pub v: GateGradient<T>,
}

/// Room for ŝ and s̄ of the gates: of a part of u, and of all of v.
#[derive(Debug)]
pub struct Scratch<T> {
    u: Aligned<T>,
    v: Aligned<T>,
}

impl<T: Real> Scratch<T> {
    pub fn new() -> Self {
        Self { u: zeros(0), v: zeros(0) }
    }
}

/// What the passes leave for each other.
#[derive(Debug)]
pub struct GatesTape<T> {
    u: GateTape<T>,
    v: GateTape<T>,
}

impl<T: Real> Gated<T> {
    pub fn named(name: &str, weights: &impl Weights<T>) -> Self {
        let [u, v] = ["u", "v"].map(|gate| Gate::named(&format!("{name}.{gate}"), weights));
        Self { linear: Linear::named(name, weights), u, v }
    }

    pub fn gradient(&self) -> GatesGradient<T> {
        GatesGradient { u: self.u.gradient(), v: self.v.gradient() }
    }

    pub fn tape(&self, rows: usize) -> GatesTape<T> {
        GatesTape { u: self.u.tape(rows), v: self.v.tape(rows) }
    }

    /// Outputs whose attenuations stay in the nearest cache from one step of a pass to the next.
    fn parts(&self, rows: usize) -> impl Iterator<Item = Range<usize>> + use<T> {
        let Linear { inputs, outputs, .. } = self.linear;
        let panel = self.u.granule();
        let least = (1..panel).find(|count| (count * inputs).is_multiple_of(panel)).unwrap_or(panel);
        let count = (PART / (rows * inputs)).next_multiple_of(least).max(least);
        (0..outputs).step_by(count).map(move |first| first..outputs.min(first + count))
    }

    /// The attenuations of weights that belong to some outputs.
    fn weights(&self, outputs: &Range<usize>) -> Range<usize> {
        outputs.start * self.linear.inputs..outputs.end * self.linear.inputs
    }

    /// y of x.
    pub fn forward(&self, rows: usize, x: &[T], tape: &mut GatesTape<T>, y: &mut [T]) {
        let (linear, v_bias) = (&self.linear, self.v.bias(&self.v.all()));
        self.u.enter(rows, x, &mut tape.u);
        self.v.enter(rows, x, &mut tape.v);
        let v = self.v.forward(rows, &self.v.all(), &mut tape.v);
        Arch::new().dispatch(Sigmoid { s: v, bias: v_bias });
        for outputs in self.parts(rows) {
            let weights = self.weights(&outputs);
            let u = self.u.forward(rows, &weights, &mut tape.u);
            let u_bias = self.u.bias(&weights);
            Arch::new().dispatch(Forward { linear, outputs, u_bias, x, u, v, y });
        }
    }

    /// Adds to x̄ what ȳ gives.
    pub fn backward(
        &self,
        rows: usize,
        (x, y_bar): (&[T], &[T]),
        tape: &mut GatesTape<T>,
        scratch: &mut Scratch<T>,
        x_bar: &mut [T],
    ) {
        let linear = &self.linear;
        let s_v = grown(&mut scratch.v, rows * linear.outputs);
        let v = tape.v.out(rows, &self.v.all());
        for outputs in self.parts(rows) {
            let weights = self.weights(&outputs);
            let s_u = grown(&mut scratch.u, rows * weights.len());
            let u = tape.u.out(rows, &weights);
            Arch::new().dispatch(Backward { linear, outputs, x, u, v, y_bar, x_bar, s_u, s_v });
            self.u.backward(rows, &weights, s_u, &mut tape.u);
        }
        self.v.backward(rows, &self.v.all(), s_v, &mut tape.v);
        self.u.leave_backward(rows, &mut tape.u, x_bar);
        self.v.leave_backward(rows, &mut tape.v, x_bar);
    }

    /// ẏ of ẋ; `x` holds x and ẋ.
    pub fn tangent(&self, rows: usize, x: &[T], tape: &mut GatesTape<T>, y_dot: &mut [T]) {
        let linear = &self.linear;
        let (x, x_dot) = x.split_at(rows * linear.inputs);
        self.u.enter_tangent(rows, x_dot, &mut tape.u);
        self.v.enter_tangent(rows, x_dot, &mut tape.v);
        self.v.tangent(rows, &self.v.all(), &mut tape.v);
        let (v, s_dot_v) = (tape.v.out(rows, &self.v.all()), tape.v.s_dot(rows, &self.v.all()));
        for outputs in self.parts(rows) {
            let weights = self.weights(&outputs);
            self.u.tangent(rows, &weights, &mut tape.u);
            let (u, s_dot_u) = (tape.u.out(rows, &weights), tape.u.s_dot(rows, &weights));
            Arch::new().dispatch(Tangent { linear, outputs, x, x_dot, u, v, s_dot_u, s_dot_v, y_dot });
        }
    }

    /// Adds to x̂ and to the gradients what ŷ gives. `x` and `y` hold x and ŷ and, in the second order, ẋ and ȳ after them.
    pub fn adjoint(
        &self,
        rows: usize,
        (x, y): (&[T], &[T]),
        tape: &mut GatesTape<T>,
        scratch: &mut Scratch<T>,
        x_hat: &mut [T],
        (gradient, gates): (&mut LinearGradient<T>, &mut GatesGradient<T>),
    ) {
        let linear = &self.linear;
        let Linear { inputs, outputs, .. } = *linear;
        let stacked = x.len() / inputs;
        let s_v = grown(&mut scratch.v, stacked * outputs);
        let v = tape.v.out(rows, &self.v.all());
        for outputs in self.parts(rows) {
            let weights = self.weights(&outputs);
            let s_u = grown(&mut scratch.u, stacked * weights.len());
            let u = tape.u.out(rows, &weights);
            if stacked == rows {
                let (x_hat, s_u, s_v, gradient) = (&mut *x_hat, &mut *s_u, &mut *s_v, &mut *gradient);
                Arch::new().dispatch(FirstAdjoint { linear, outputs, x, u, v, y_hat: y, x_hat, s_u, s_v, gradient });
            } else {
                Arch::new().dispatch(SecondAdjoint {
                    linear,
                    x: x.split_at(rows * inputs),
                    u,
                    v,
                    s_dot_u: tape.u.s_dot(rows, &weights),
                    s_dot_v: tape.v.s_dot(rows, &self.v.all()),
                    y: y.split_at(rows * linear.outputs),
                    x_hat,
                    s_u: s_u.split_at_mut(rows * weights.len()),
                    s_v: s_v.split_at_mut(rows * linear.outputs),
                    gradient,
                    outputs,
                });
            }
            self.u.adjoint(rows, &weights, s_u, &mut tape.u, &mut gates.u);
        }
        self.v.adjoint(rows, &self.v.all(), s_v, &mut tape.v, &mut gates.v);
        self.u.leave_adjoint(rows, x, &mut tape.u, x_hat, &mut gates.u);
        self.v.leave_adjoint(rows, x, &mut tape.v, x_hat, &mut gates.v);
    }
}
