//! What the passes over a neuromodulated layer do for each weight. The formulas stand in [`gated`](super::gated).
//!
//! Each kernel runs over R samples and some of the outputs; `a` is `[outputs, inputs]`, what belongs to u is `[R, some outputs,
//! inputs]`, the rest `[R, inputs]` or `[R, outputs]`.

use super::lanes::{Lanes, registers, registers_mut};
use super::linear::{Linear, LinearGradient};
use super::real::Real;
use pulp::{Simd, WithSimd};
use std::ops::Range;

/// σ(s) of s - b₂, row by row.
#[derive(Debug)]
pub struct Sigmoid<'a, T> {
    pub s: &'a mut [T],
    pub bias: &'a [T],
}

impl<T: Real> WithSimd for Sigmoid<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let count = Lanes::<S, T>::COUNT;
        for row in self.s.chunks_exact_mut(self.bias.len()) {
            for (s, bias) in row.chunks_mut(count).zip(self.bias.chunks(count)) {
                (Lanes::load(simd, s) + Lanes::load(simd, bias)).sigmoid().store(s);
            }
        }
    }
}

/// Some of y; turns s - b₂ into u on the way.
#[derive(Debug)]
pub struct Forward<'a, T> {
    pub linear: &'a Linear<T>,
    pub outputs: Range<usize>,
    pub u_bias: &'a [T],
    pub x: &'a [T],
    pub u: &'a mut [T],
    pub v: &'a [T],
    pub y: &'a mut [T],
}

impl<T: Real> WithSimd for Forward<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { linear, outputs: part, u_bias, x, u, v, y } = self;
        let Linear { inputs, outputs, .. } = *linear;
        let weight = &linear.weight()[part.start * inputs..];
        for (r, x) in x.chunks_exact(inputs).enumerate() {
            for (j, o) in part.clone().enumerate() {
                let at = r * outputs + o;
                let u = &mut u[(r * part.len() + j) * inputs..][..inputs];
                let row = j * inputs..(j + 1) * inputs;
                let (u_bias, a) = (&u_bias[row.clone()], &weight[row]);
                let sum = open(simd, u, [u_bias, a, x]);
                y[at] = sum.sum() + v[at] * linear.bias()[o];
            }
        }
    }
}

/// Turns a row of s - b₂ into u, and answers Σ u a x, yet to be summed over the lanes.
#[inline(always)]
fn open<S: Simd, T: Real>(simd: S, u: &mut [T], [bias, a, x]: [&[T]; 3]) -> Lanes<S, T> {
    let mut sum = Lanes::splat(simd, T::ZERO);
    let count = u.len() / Lanes::<S, T>::COUNT;
    {
        // Slices of registers, all as long, are read without looking for their ends each time.
        let [u] = registers_mut(simd, [&mut *u], count);
        let [bias, a, x] = registers(simd, [bias, a, x], count);
        for i in 0..count {
            u[i] = open_lanes(Lanes::each(simd, [u[i], bias[i], a[i], x[i]]), &mut sum).values();
        }
    }
    let rest = count * Lanes::<S, T>::COUNT..u.len();
    if !rest.is_empty() {
        let rows = [&u[rest.clone()], &bias[rest.clone()], &a[rest.clone()], &x[rest.clone()]];
        open_lanes(Lanes::load_each(simd, rows), &mut sum).store(&mut u[rest]);
    }
    sum
}

#[inline(always)]
fn open_lanes<S: Simd, T: Real>([s, bias, a, x]: [Lanes<S, T>; 4], sum: &mut Lanes<S, T>) -> Lanes<S, T> {
    let open = (s + bias).sigmoid();
    *sum = (open * a).mul_add(x, *sum);
    open
}

/// Adds to x̄; s̄ of both gates.
#[derive(Debug)]
pub struct Backward<'a, T> {
    pub linear: &'a Linear<T>,
    pub outputs: Range<usize>,
    pub x: &'a [T],
    pub u: &'a [T],
    pub v: &'a [T],
    pub y_bar: &'a [T],
    pub x_bar: &'a mut [T],
    pub s_u: &'a mut [T],
    pub s_v: &'a mut [T],
}

impl<T: Real> WithSimd for Backward<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { linear, outputs: part, x, u, v, y_bar, x_bar, s_u, s_v } = self;
        let Linear { inputs, outputs, .. } = *linear;
        let one = Lanes::splat(simd, T::ONE);
        let weight = &linear.weight()[part.start * inputs..];
        for (r, x) in x.chunks_exact(inputs).enumerate() {
            let block = r * part.len() * inputs;
            let y_bar = &y_bar[r * outputs..][part.clone()];
            for i in (0..inputs).step_by(Lanes::<S, T>::COUNT) {
                let x_bar = &mut x_bar[r * inputs..][i..inputs];
                let (x, mut sum) = (Lanes::load(simd, &x[i..]), Lanes::load(simd, x_bar));
                for (j, y) in y_bar.iter().enumerate() {
                    let (from, to) = (j * inputs + i, (j + 1) * inputs);
                    let [u, a] = Lanes::load_each(simd, [&u[block..][from..to], &weight[from..to]]);
                    let open = Lanes::splat(simd, *y) * u * a;
                    sum = sum + open;
                    (open * (one - u) * x).store(&mut s_u[block..][from..to]);
                }
                sum.store(x_bar);
            }
            for (o, y_bar) in part.clone().zip(y_bar) {
                let at = r * outputs + o;
                s_v[at] = *y_bar * linear.bias()[o] * v[at] * (T::ONE - v[at]);
            }
        }
    }
}

/// ẏ.
#[derive(Debug)]
pub struct Tangent<'a, T> {
    pub linear: &'a Linear<T>,
    pub outputs: Range<usize>,
    pub x: &'a [T],
    pub x_dot: &'a [T],
    pub u: &'a [T],
    pub v: &'a [T],
    pub s_dot_u: &'a [T],
    pub s_dot_v: &'a [T],
    pub y_dot: &'a mut [T],
}

impl<T: Real> WithSimd for Tangent<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { linear, outputs: part, x, x_dot, u, v, s_dot_u, s_dot_v, y_dot } = self;
        let Linear { inputs, outputs, .. } = *linear;
        let one = Lanes::splat(simd, T::ONE);
        for r in 0..x.len() / inputs {
            let row = r * inputs..(r + 1) * inputs;
            let (x, x_dot) = (&x[row.clone()], &x_dot[row]);
            for (j, o) in part.clone().enumerate() {
                let (at, place) = (r * outputs + o, (r * part.len() + j) * inputs);
                let a = &linear.weight()[o * inputs..][..inputs];
                let (u, s_dot) = (&u[place..][..inputs], &s_dot_u[place..][..inputs]);
                let mut sum = Lanes::splat(simd, T::ZERO);
                for i in (0..inputs).step_by(Lanes::<S, T>::COUNT) {
                    let [u, s_dot, a] = Lanes::load_each(simd, [&u[i..], &s_dot[i..], &a[i..]]);
                    let [x, x_dot] = Lanes::load_each(simd, [&x[i..], &x_dot[i..]]);
                    sum = (a * u).mul_add(((one - u) * s_dot).mul_add(x, x_dot), sum);
                }
                y_dot[at] = sum.sum() + v[at] * (T::ONE - v[at]) * s_dot_v[at] * linear.bias()[o];
            }
        }
    }
}

/// Adds to x̂ and to the gradient; ŝ of both gates: the terms of ŷ.
#[derive(Debug)]
pub struct FirstAdjoint<'a, T> {
    pub linear: &'a Linear<T>,
    pub outputs: Range<usize>,
    pub x: &'a [T],
    pub u: &'a [T],
    pub v: &'a [T],
    pub y_hat: &'a [T],
    pub x_hat: &'a mut [T],
    pub s_u: &'a mut [T],
    pub s_v: &'a mut [T],
    pub gradient: &'a mut LinearGradient<T>,
}

impl<T: Real> WithSimd for FirstAdjoint<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { linear, outputs: part, x, u, v, y_hat, x_hat, s_u, s_v, gradient } = self;
        let Linear { inputs, outputs, .. } = *linear;
        let one = Lanes::splat(simd, T::ONE);
        let weights = part.start * inputs..part.end * inputs;
        let (weight, in_weight) = (&linear.weight()[weights.clone()], &mut gradient.weight[weights.clone()]);
        for (r, x) in x.chunks_exact(inputs).enumerate() {
            let block = r * weights.len();
            let y_hat = &y_hat[r * outputs..][part.clone()];
            for i in (0..inputs).step_by(Lanes::<S, T>::COUNT) {
                let x_hat = &mut x_hat[r * inputs..][i..inputs];
                let (x, mut sum) = (Lanes::load(simd, &x[i..]), Lanes::load(simd, x_hat));
                for (j, y) in y_hat.iter().enumerate() {
                    let (from, to) = (j * inputs + i, (j + 1) * inputs);
                    let [u, a] = Lanes::load_each(simd, [&u[block..][from..to], &weight[from..to]]);
                    let open = Lanes::splat(simd, *y) * u;
                    sum = open.mul_add(a, sum);
                    (open * x).add_to(&mut in_weight[from..to]);
                    (open * (one - u) * a * x).store(&mut s_u[block..][from..to]);
                }
                sum.store(x_hat);
            }
            for (o, y_hat) in part.clone().zip(y_hat) {
                let at = r * outputs + o;
                let open = *y_hat * v[at];
                gradient.bias[o] += open;
                s_v[at] = open * (T::ONE - v[at]) * linear.bias()[o];
            }
        }
    }
}

/// Adds to x̂ and to the gradient; ŝ and s̄ of both gates: the terms of ŷ and of ȳ.
#[derive(Debug)]
pub struct SecondAdjoint<'a, T> {
    pub linear: &'a Linear<T>,
    pub outputs: Range<usize>,
    /// x and ẋ.
    pub x: (&'a [T], &'a [T]),
    pub u: &'a [T],
    pub v: &'a [T],
    pub s_dot_u: &'a [T],
    pub s_dot_v: &'a [T],
    /// ŷ and ȳ.
    pub y: (&'a [T], &'a [T]),
    pub x_hat: &'a mut [T],
    /// ŝ and s̄.
    pub s_u: (&'a mut [T], &'a mut [T]),
    pub s_v: (&'a mut [T], &'a mut [T]),
    pub gradient: &'a mut LinearGradient<T>,
}

impl<T: Real> WithSimd for SecondAdjoint<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { linear, outputs: part, x: xs, u, v, s_dot_u, s_dot_v, y: ys, x_hat, s_u, s_v, gradient } = self;
        let Linear { inputs, outputs, .. } = *linear;
        let one = Lanes::splat(simd, T::ONE);
        let weights = part.start * inputs..part.end * inputs;
        let (weight, in_weight) = (&linear.weight()[weights.clone()], &mut gradient.weight[weights.clone()]);
        for r in 0..xs.0.len() / inputs {
            let row = r * inputs..(r + 1) * inputs;
            let (xs, x_hat) = ((&xs.0[row.clone()], &xs.1[row.clone()]), &mut x_hat[row]);
            let block = r * weights.len();
            let (y_hat, y_bar) = (&ys.0[r * outputs..][part.clone()], &ys.1[r * outputs..][part.clone()]);
            for i in (0..inputs).step_by(Lanes::<S, T>::COUNT) {
                let [x, x_dot, mut sum] = Lanes::load_each(simd, [&xs.0[i..], &xs.1[i..], &x_hat[i..]]);
                for (j, (y_hat, y_bar)) in y_hat.iter().zip(y_bar).enumerate() {
                    let (from, to) = (j * inputs + i, (j + 1) * inputs);
                    let [u, s_dot] = Lanes::load_each(simd, [&u[block..][from..to], &s_dot_u[block..][from..to]]);
                    let (a, in_a) = (Lanes::load(simd, &weight[from..to]), &mut in_weight[from..to]);
                    let (y_hat, y_bar) = (Lanes::splat(simd, *y_hat), Lanes::splat(simd, *y_bar));
                    let shut = one - u;
                    let slope = u * shut;
                    let moved = y_bar * s_dot;
                    let (p, q) = (y_hat.mul_add(x, y_bar * x_dot), moved * x);
                    sum = a.mul_add(y_hat.mul_add(u, moved * slope), sum);
                    u.mul_add(p, slope * q).add_to(in_a);
                    let slope = a * slope;
                    (slope * (shut - u).mul_add(q, p)).store(&mut s_u.0[block..][from..to]);
                    (slope * y_bar * x).store(&mut s_u.1[block..][from..to]);
                }
                sum.store(&mut x_hat[i..]);
            }
            for (o, (y_hat, y_bar)) in part.clone().zip(y_hat.iter().zip(y_bar)) {
                let at = r * outputs + o;
                let (v, b) = (v[at], linear.bias()[o]);
                let (slope, moved) = (v * (T::ONE - v), *y_bar * s_dot_v[at]);
                gradient.bias[o] += v * *y_hat + slope * moved;
                s_v.0[at] = b * slope * (*y_hat + (T::ONE - v - v) * moved);
                s_v.1[at] = b * slope * *y_bar;
            }
        }
    }
}
