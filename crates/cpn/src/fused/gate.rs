//! u_β or v_γ: two linear layers with a rectified linear unit between. The sigmoid at the end belongs to the [layer that is
//! attenuated](super::gated), which runs over the same numbers anyway, and asks for them part by part.

use super::lanes::{Aligned, zeros};
use super::linear::{Linear, LinearGradient, Weights};
use super::real::Real;
use pulp::{Arch, Simd, WithSimd};
use std::ops::Range;

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
    /// h and ḣ, `[2 R, width]`.
    h: Aligned<T>,
    /// ĥ and h̄, `[2 R, width]`.
    h_adjoint: Aligned<T>,
    /// First s - b₂, then σ(s): for each part `[R, its outputs]`.
    out: Aligned<T>,
    /// ṡ, likewise.
    s_dot: Aligned<T>,
}

impl<T: Real> GateTape<T> {
    pub fn out(&self, rows: usize, part: &Range<usize>) -> &[T] {
        &self.out[rows * part.start..rows * part.end]
    }

    pub fn s_dot(&self, rows: usize, part: &Range<usize>) -> &[T] {
        &self.s_dot[rows * part.start..rows * part.end]
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
        GateTape {
            width,
            h: zeros(2 * rows * width),
            h_adjoint: zeros(2 * rows * width),
            out: zeros(rows * outputs),
            s_dot: zeros(rows * outputs),
        }
    }

    /// All that it attenuates.
    pub fn all(&self) -> Range<usize> {
        self.output.all()
    }

    /// The fewest outputs whose multiples make parts.
    pub fn granule(&self) -> usize {
        self.output.granule()
    }

    /// b₂ of a part.
    pub fn bias(&self, part: &Range<usize>) -> &[T] {
        &self.output.bias()[part.clone()]
    }

    /// Before any [`Self::forward`]: leaves h of x `[R, inputs]` on the tape.
    pub fn enter(&self, rows: usize, x: &[T], tape: &mut GateTape<T>) {
        let h = &mut tape.h[..rows * tape.width];
        self.hidden.forward(x, h);
        rectify(h);
    }

    /// Leaves s - b₂ on the tape: who goes on from there adds b₂ on the way.
    pub fn forward<'a>(&self, rows: usize, part: &Range<usize>, tape: &'a mut GateTape<T>) -> &'a mut [T] {
        let out = &mut tape.out[rows * part.start..rows * part.end];
        self.output.tangent(part.clone(), &tape.h[..rows * tape.width], out);
        out
    }

    /// Before any [`Self::tangent`]: leaves ḣ of ẋ `[R, inputs]` on the tape.
    pub fn enter_tangent(&self, rows: usize, x_dot: &[T], tape: &mut GateTape<T>) {
        let (h, h_dot) = tape.h[..2 * rows * tape.width].split_at_mut(rows * tape.width);
        self.hidden.tangent(self.hidden.all(), x_dot, h_dot);
        mask(h_dot, h);
    }

    /// Leaves ṡ on the tape.
    pub fn tangent(&self, rows: usize, part: &Range<usize>, tape: &mut GateTape<T>) {
        let h_dot = &tape.h[rows * tape.width..2 * rows * tape.width];
        self.output.tangent(part.clone(), h_dot, &mut tape.s_dot[rows * part.start..rows * part.end]);
    }

    /// Adds up h̄ from s̄ of a part, the first of which begins anew.
    pub fn backward(&self, rows: usize, part: &Range<usize>, s_bar: &[T], tape: &mut GateTape<T>) {
        let h_bar = &mut tape.h_adjoint[rows * tape.width..2 * rows * tape.width];
        self.output.backward(part.start > 0, part.clone(), s_bar, h_bar);
    }

    /// After every [`Self::backward`]: adds to x̄ what h̄ gives.
    pub fn leave_backward(&self, rows: usize, tape: &mut GateTape<T>, x_bar: &mut [T]) {
        let h_bar = &mut tape.h_adjoint[rows * tape.width..2 * rows * tape.width];
        mask(h_bar, &tape.h[..rows * tape.width]);
        self.hidden.backward(true, self.hidden.all(), h_bar, x_bar);
    }

    /// Adds up ĥ, and adds to the gradient, what `s`, ŝ of a part and in the second order s̄ after it, gives.
    pub fn adjoint(
        &self,
        rows: usize,
        part: &Range<usize>,
        s: &[T],
        tape: &mut GateTape<T>,
        gradient: &mut GateGradient<T>,
    ) {
        let stacked = s.len() / part.len() * tape.width;
        let h_hat = &mut tape.h_adjoint[..rows * tape.width];
        self.output.accumulate_all(part.clone(), rows, (&tape.h[..stacked], s), &mut gradient.output);
        self.output.backward(part.start > 0, part.clone(), &s[..rows * part.len()], h_hat);
    }

    /// After every [`Self::adjoint`]: adds to x̂, and to the gradient, what ĥ and in the second order h̄ give; `x` holds x and
    /// likewise ẋ.
    pub fn leave_adjoint(
        &self,
        rows: usize,
        x: &[T],
        tape: &mut GateTape<T>,
        x_hat: &mut [T],
        gradient: &mut GateGradient<T>,
    ) {
        let (size, stacked) = (rows * tape.width, x.len() / self.hidden.inputs * tape.width);
        let h_hat = &mut tape.h_adjoint[..size];
        mask(h_hat, &tape.h[..size]);
        self.hidden.backward(true, self.hidden.all(), h_hat, x_hat);
        self.hidden.accumulate_all(self.hidden.all(), rows, (x, &tape.h_adjoint[..stacked]), &mut gradient.hidden);
    }
}

/// relu(x), in place. What is not a number stays so, for somebody to see.
pub fn rectify<T: Real>(x: &mut [T]) {
    Arch::new().dispatch(Rectify { x });
}

/// The derivative of [`rectify`] times `x`, where `rectified` is what it left.
pub fn mask<T: Real>(x: &mut [T], rectified: &[T]) {
    Arch::new().dispatch(Mask { x, rectified });
}

#[derive(Debug)]
struct Rectify<'a, T> {
    x: &'a mut [T],
}

impl<T: Real> WithSimd for Rectify<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        for x in self.x {
            *x = if *x < T::ZERO { T::ZERO } else { *x };
        }
    }
}

#[derive(Debug)]
struct Mask<'a, T> {
    x: &'a mut [T],
    rectified: &'a [T],
}

impl<T: Real> WithSimd for Mask<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        for (x, rectified) in self.x.iter_mut().zip(self.rectified) {
            *x = if *rectified > T::ZERO { *x } else { T::ZERO };
        }
    }
}
