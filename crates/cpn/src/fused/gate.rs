//! u_β or v_γ: two linear layers with a rectified linear unit between. The sigmoid at the end belongs to the [layer that is
//! attenuated](super::gated), which runs over the same numbers anyway.

use super::linear::{Linear, LinearGradient, Weights};
use super::real::Real;

/// An attenuation network up to its sigmoid: s = a₂ h + b₂, h = relu(a₁ x + b₁).
#[derive(Debug)]
pub struct Gate<T> {
    hidden: Linear<T>,
    output: Linear<T>,
}

/// What a loss changes by when a gate's weights do.
#[derive(Debug)]
pub struct GateGradient<T> {
    pub hidden: LinearGradient<T>,
    pub output: LinearGradient<T>,
}

/// What the passes over a gate leave for each other.
#[derive(Debug)]
pub struct GateTape<T> {
    width: usize,
    outputs: usize,
    /// h and ḣ, `[2 R, width]`.
    h: Vec<T>,
    /// ĥ and h̄, `[2 R, width]`.
    h_adjoint: Vec<T>,
    /// First s - b₂, then σ(s), `[R, outputs]`.
    out: Vec<T>,
    /// ṡ, `[R, outputs]`.
    s_dot: Vec<T>,
}

impl<T: Real> GateTape<T> {
    pub fn out(&self, rows: usize) -> &[T] {
        &self.out[..rows * self.outputs]
    }

    pub fn out_mut(&mut self, rows: usize) -> &mut [T] {
        &mut self.out[..rows * self.outputs]
    }

    pub fn s_dot(&self, rows: usize) -> &[T] {
        &self.s_dot[..rows * self.outputs]
    }
}

impl<T: Real> Gate<T> {
    pub fn named(name: &str, weights: &impl Weights<T>) -> Self {
        let [hidden, output] = ["hidden", "output"].map(|layer| Linear::named(&format!("{name}.{layer}"), weights));
        Self { hidden, output }
    }

    pub fn gradient(&self) -> GateGradient<T> {
        GateGradient { hidden: self.hidden.gradient(), output: self.output.gradient() }
    }

    pub fn tape(&self, rows: usize) -> GateTape<T> {
        let (width, outputs) = (self.hidden.outputs, self.output.outputs);
        let zeros = |size| vec![T::ZERO; rows * size];
        GateTape {
            width,
            outputs,
            h: zeros(2 * width),
            h_adjoint: zeros(2 * width),
            out: zeros(outputs),
            s_dot: zeros(outputs),
        }
    }

    /// b₂, `[outputs]`.
    pub fn bias(&self) -> &[T] {
        self.output.bias()
    }

    /// Leaves s - b₂ of x `[R, inputs]` on the tape: who goes on from there adds b₂ on the way.
    pub fn forward(&self, rows: usize, x: &[T], tape: &mut GateTape<T>) {
        let h = &mut tape.h[..rows * tape.width];
        self.hidden.forward(x, h);
        rectify(h);
        self.output.tangent(h, &mut tape.out[..rows * tape.outputs]);
    }

    /// Adds to x̄ what s̄ gives.
    pub fn backward(&self, rows: usize, s_bar: &[T], tape: &mut GateTape<T>, x_bar: &mut [T]) {
        let size = rows * tape.width;
        let h_bar = &mut tape.h_adjoint[size..2 * size];
        h_bar.fill(T::ZERO);
        self.output.backward(s_bar, h_bar);
        mask(h_bar, &tape.h[..size]);
        self.hidden.backward(h_bar, x_bar);
    }

    /// Leaves ṡ of ẋ `[R, inputs]` on the tape.
    pub fn tangent(&self, rows: usize, x_dot: &[T], tape: &mut GateTape<T>) {
        let (h, h_dot) = tape.h[..2 * rows * tape.width].split_at_mut(rows * tape.width);
        self.hidden.tangent(x_dot, h_dot);
        mask(h_dot, h);
        self.output.tangent(h_dot, &mut tape.s_dot[..rows * tape.outputs]);
    }

    /// Adds to x̂, and to the gradient, what `s`, ŝ and in the second order s̄ after it, gives; `x` likewise holds x and ẋ.
    pub fn adjoint(
        &self,
        rows: usize,
        x: &[T],
        s: &[T],
        tape: &mut GateTape<T>,
        x_hat: &mut [T],
        gradient: &mut GateGradient<T>,
    ) {
        let (size, stacked) = (rows * tape.width, s.len() / tape.outputs * tape.width);
        self.output.accumulate(rows, (&tape.h[..stacked], s), &mut gradient.output);
        let h_hat = &mut tape.h_adjoint[..size];
        h_hat.fill(T::ZERO);
        self.output.backward(&s[..rows * tape.outputs], h_hat);
        mask(h_hat, &tape.h[..size]);
        self.hidden.backward(h_hat, x_hat);
        self.hidden.accumulate(rows, (x, &tape.h_adjoint[..stacked]), &mut gradient.hidden);
    }
}

/// relu(x), in place. What is not a number stays so, for somebody to see.
pub fn rectify<T: Real>(x: &mut [T]) {
    for x in x {
        *x = if *x < T::ZERO { T::ZERO } else { *x };
    }
}

/// The derivative of [`rectify`] times `x`, where `rectified` is what it left.
pub fn mask<T: Real>(x: &mut [T], rectified: &[T]) {
    for (x, rectified) in x.iter_mut().zip(rectified) {
        *x = if *rectified > T::ZERO { *x } else { T::ZERO };
    }
}
