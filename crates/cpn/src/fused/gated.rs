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

use super::Scratch;
use super::gate::{Gate, GateGradient, GateTape};
use super::linear::{Linear, LinearGradient, Weights};
use super::modulation::{Backward, FirstAdjoint, Forward, SecondAdjoint, Tangent};
use super::real::Real;
use pulp::Arch;

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

    /// y of x.
    pub fn forward(&self, rows: usize, x: &[T], tape: &mut GatesTape<T>, y: &mut [T]) {
        self.u.forward(rows, x, &mut tape.u);
        self.v.forward(rows, x, &mut tape.v);
        let (u, v) = (tape.u.out_mut(rows), tape.v.out_mut(rows));
        let (u_bias, v_bias) = (self.u.bias(), self.v.bias());
        Arch::new().dispatch(Forward { linear: &self.linear, u_bias, v_bias, x, u, v, y });
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
        let (s_u, s_v) = scratch.split(rows, self.linear.inputs, self.linear.outputs);
        let (u, v) = (tape.u.out(rows), tape.v.out(rows));
        Arch::new().dispatch(Backward { linear: &self.linear, x, u, v, y_bar, x_bar, s_u, s_v });
        self.u.backward(rows, s_u, &mut tape.u, x_bar);
        self.v.backward(rows, s_v, &mut tape.v, x_bar);
    }

    /// ẏ of ẋ; `x` holds x and ẋ.
    pub fn tangent(&self, rows: usize, x: &[T], tape: &mut GatesTape<T>, y_dot: &mut [T]) {
        let (x, x_dot) = x.split_at(rows * self.linear.inputs);
        self.u.tangent(rows, x_dot, &mut tape.u);
        self.v.tangent(rows, x_dot, &mut tape.v);
        let (u, v, s_dot_u, s_dot_v) = (tape.u.out(rows), tape.v.out(rows), tape.u.s_dot(rows), tape.v.s_dot(rows));
        Arch::new().dispatch(Tangent { linear: &self.linear, x, x_dot, u, v, s_dot_u, s_dot_v, y_dot });
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
        let (s_u, s_v) = scratch.split(x.len() / inputs, inputs, outputs);
        let (u, v) = (tape.u.out(rows), tape.v.out(rows));
        if x.len() == rows * inputs {
            let x_hat = &mut *x_hat;
            Arch::new().dispatch(FirstAdjoint { linear, x, u, v, y_hat: y, x_hat, s_u, s_v, gradient });
        } else {
            Arch::new().dispatch(SecondAdjoint {
                linear,
                x: x.split_at(rows * inputs).into(),
                u,
                v,
                s_dot_u: tape.u.s_dot(rows),
                s_dot_v: tape.v.s_dot(rows),
                y: y.split_at(rows * outputs).into(),
                x_hat,
                s_u: s_u.split_at_mut(rows * outputs * inputs),
                s_v: s_v.split_at_mut(rows * outputs),
                gradient,
            });
        }
        self.u.adjoint(rows, x, s_u, &mut tape.u, x_hat, &mut gates.u);
        self.v.adjoint(rows, x, s_v, &mut tape.v, x_hat, &mut gates.v);
    }
}
