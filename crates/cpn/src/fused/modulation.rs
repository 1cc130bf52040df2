//! What the passes over a neuromodulated layer do for each weight. The formulas stand in [`gated`](super::gated).
//!
//! Each kernel runs over R samples; `a` is `[outputs, inputs]`, what belongs to u is `[R, outputs, inputs]`, the rest
//! `[R, inputs]` or `[R, outputs]`.

use super::lanes::Lanes;
use super::linear::{Linear, LinearGradient};
use super::real::Real;
use pulp::{Simd, WithSimd};

/// y; turns s - b₂ into u and v on the way.
#[derive(Debug)]
pub struct Forward<'a, T> {
    pub linear: &'a Linear<T>,
    pub u_bias: &'a [T],
    pub v_bias: &'a [T],
    pub x: &'a [T],
    pub u: &'a mut [T],
    pub v: &'a mut [T],
    pub y: &'a mut [T],
}

impl<T: Real> WithSimd for Forward<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { linear, u_bias, v_bias, x, u, v, y } = self;
        let inputs = linear.inputs;
        let samples = x.chunks_exact(inputs).zip(u.chunks_exact_mut(u_bias.len()));
        let samples = samples.zip(v.chunks_exact_mut(linear.outputs)).zip(y.chunks_exact_mut(linear.outputs));
        for (((x, u), v), y) in samples {
            let rows = u.chunks_exact_mut(inputs).zip(u_bias.chunks_exact(inputs));
            for (o, ((u, u_bias), a)) in rows.zip(linear.weight().chunks_exact(inputs)).enumerate() {
                let mut sum = Lanes::splat(simd, T::ZERO);
                for i in (0..inputs).step_by(Lanes::<S, T>::COUNT) {
                    let [s, bias, a, x] = [&u[i..], &u_bias[i..], &a[i..], &x[i..]].map(|s| Lanes::load(simd, s));
                    let open = (s + bias).sigmoid();
                    open.store(&mut u[i..]);
                    sum = (open * a).mul_add(x, sum);
                }
                v[o] = (v[o] + v_bias[o]).sigmoid();
                y[o] = sum.sum() + v[o] * linear.bias()[o];
            }
        }
    }
}

/// Adds to x̄; s̄ of both gates.
#[derive(Debug)]
pub struct Backward<'a, T> {
    pub linear: &'a Linear<T>,
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
        let Self { linear, x, u, v, y_bar, x_bar, s_u, s_v } = self;
        let Linear { inputs, outputs, .. } = *linear;
        let one = Lanes::splat(simd, T::ONE);
        for r in 0..x.len() / inputs {
            let (x, x_bar) = (&x[r * inputs..][..inputs], &mut x_bar[r * inputs..][..inputs]);
            for (o, a) in linear.weight().chunks_exact(inputs).enumerate() {
                let at = r * outputs + o;
                let (u, s_u) = (&u[at * inputs..][..inputs], &mut s_u[at * inputs..][..inputs]);
                let y = Lanes::splat(simd, y_bar[at]);
                for i in (0..inputs).step_by(Lanes::<S, T>::COUNT) {
                    let [u, a, x] = [&u[i..], &a[i..], &x[i..]].map(|s| Lanes::load(simd, s));
                    let direct = y * u * a;
                    direct.add_to(&mut x_bar[i..]);
                    (direct * (one - u) * x).store(&mut s_u[i..]);
                }
                s_v[at] = y_bar[at] * linear.bias()[o] * v[at] * (T::ONE - v[at]);
            }
        }
    }
}

/// ẏ.
#[derive(Debug)]
pub struct Tangent<'a, T> {
    pub linear: &'a Linear<T>,
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
        let Self { linear, x, x_dot, u, v, s_dot_u, s_dot_v, y_dot } = self;
        let Linear { inputs, outputs, .. } = *linear;
        let one = Lanes::splat(simd, T::ONE);
        for r in 0..x.len() / inputs {
            let [x, x_dot] = [x, x_dot].map(|x| &x[r * inputs..][..inputs]);
            for (o, a) in linear.weight().chunks_exact(inputs).enumerate() {
                let at = r * outputs + o;
                let [u, s_dot] = [u, s_dot_u].map(|u| &u[at * inputs..][..inputs]);
                let mut sum = Lanes::splat(simd, T::ZERO);
                for i in (0..inputs).step_by(Lanes::<S, T>::COUNT) {
                    let [u, s_dot, a] = [&u[i..], &s_dot[i..], &a[i..]].map(|s| Lanes::load(simd, s));
                    let [x, x_dot] = [&x[i..], &x_dot[i..]].map(|s| Lanes::load(simd, s));
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
        let Self { linear, x, u, v, y_hat, x_hat, s_u, s_v, gradient } = self;
        let Linear { inputs, outputs, .. } = *linear;
        let one = Lanes::splat(simd, T::ONE);
        for r in 0..x.len() / inputs {
            let (x, x_hat) = (&x[r * inputs..][..inputs], &mut x_hat[r * inputs..][..inputs]);
            for (o, a) in linear.weight().chunks_exact(inputs).enumerate() {
                let at = r * outputs + o;
                let (u, s_u) = (&u[at * inputs..][..inputs], &mut s_u[at * inputs..][..inputs]);
                let in_a = &mut gradient.weight[o * inputs..][..inputs];
                let y = Lanes::splat(simd, y_hat[at]);
                for i in (0..inputs).step_by(Lanes::<S, T>::COUNT) {
                    let [u, a, x] = [&u[i..], &a[i..], &x[i..]].map(|s| Lanes::load(simd, s));
                    let open = y * u;
                    (open * a).add_to(&mut x_hat[i..]);
                    (open * x).add_to(&mut in_a[i..]);
                    (open * (one - u) * a * x).store(&mut s_u[i..]);
                }
                let open = y_hat[at] * v[at];
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
    /// x and ẋ.
    pub x: [&'a [T]; 2],
    pub u: &'a [T],
    pub v: &'a [T],
    pub s_dot_u: &'a [T],
    pub s_dot_v: &'a [T],
    /// ŷ and ȳ.
    pub y: [&'a [T]; 2],
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
        let Self { linear, x, u, v, s_dot_u, s_dot_v, y, x_hat, s_u, s_v, gradient } = self;
        let Linear { inputs, outputs, .. } = *linear;
        let one = Lanes::splat(simd, T::ONE);
        for r in 0..x[0].len() / inputs {
            let [x, x_dot] = x.map(|x| &x[r * inputs..][..inputs]);
            let x_hat = &mut x_hat[r * inputs..][..inputs];
            for (o, a) in linear.weight().chunks_exact(inputs).enumerate() {
                let at = r * outputs + o;
                let [u, s_dot] = [u, s_dot_u].map(|u| &u[at * inputs..][..inputs]);
                let s_hat = &mut s_u.0[at * inputs..][..inputs];
                let s_bar = &mut s_u.1[at * inputs..][..inputs];
                let in_a = &mut gradient.weight[o * inputs..][..inputs];
                let [y_hat, y_bar] = y.map(|y| Lanes::splat(simd, y[at]));
                for i in (0..inputs).step_by(Lanes::<S, T>::COUNT) {
                    let [u, s_dot, a] = [&u[i..], &s_dot[i..], &a[i..]].map(|s| Lanes::load(simd, s));
                    let [x, x_dot] = [&x[i..], &x_dot[i..]].map(|s| Lanes::load(simd, s));
                    let shut = one - u;
                    let slope = u * shut;
                    let moved = y_bar * s_dot;
                    let (p, q) = (y_hat.mul_add(x, y_bar * x_dot), moved * x);
                    (a * y_hat.mul_add(u, moved * slope)).add_to(&mut x_hat[i..]);
                    u.mul_add(p, slope * q).add_to(&mut in_a[i..]);
                    let slope = a * slope;
                    (slope * (shut - u).mul_add(q, p)).store(&mut s_hat[i..]);
                    (slope * y_bar * x).store(&mut s_bar[i..]);
                }
                let ([y_hat, y_bar], v, b) = (y.map(|y| y[at]), v[at], linear.bias()[o]);
                let (slope, moved) = (v * (T::ONE - v), y_bar * s_dot_v[at]);
                gradient.bias[o] += v * y_hat + slope * moved;
                s_v.0[at] = b * slope * (y_hat + (T::ONE - v - v) * moved);
                s_v.1[at] = b * slope * y_bar;
            }
        }
    }
}
