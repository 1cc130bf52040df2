//! What the passes over attenuated weights do for each of them. The formulas stand in [`gated`](super::gated).
//!
//! Each kernel runs over R samples and a part of the inputs; `a` is `[inputs, O']`, what belongs to u is `[R, some inputs, O']`,
//! the rest `[R, inputs]` or `[R, O]`.

use super::attenuated::Attenuated;
use super::lanes::{Lanes, registers, registers_mut};
use super::real::Real;
use super::sparse::Part;
use pulp::{Simd, WithSimd};

/// Adds to y; turns s - b₂ into u on the way.
#[derive(Debug)]
pub struct Forward<'a, T> {
    pub layer: &'a Attenuated<T>,
    pub part: &'a Part<'a>,
    /// b₂, `[some inputs, O']`.
    pub bias: &'a [T],
    pub x: &'a [T],
    pub u: &'a mut [T],
    pub y: &'a mut [T],
}

impl<T: Real> WithSimd for Forward<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { layer, part, bias, x, u, y } = self;
        let Attenuated { inputs, outputs, ref a, .. } = *layer;
        let (width, count) = (layer.width(), Lanes::<S, T>::COUNT);
        for r in 0..part.rows {
            let (x, y) = (&x[r * inputs..][..inputs], &mut y[r * outputs..][..outputs]);
            for (w, y) in y.chunks_mut(count).enumerate() {
                let mut sum = Lanes::load(simd, y);
                for i in part.wanted(r) {
                    let at = part.at(0, i, width) + w * count;
                    let ([bias, a], u) = (
                        Lanes::load_each(simd, [&bias[at..], &a[i * width + w * count..]]),
                        &mut u[part.at(r, i, width) + w * count..],
                    );
                    let open = (Lanes::load(simd, u) + bias).sigmoid();
                    open.store(u);
                    sum = (open * a).mul_add(Lanes::splat(simd, x[i]), sum);
                }
                sum.store(y);
            }
        }
    }
}

/// Adds to x̄; s̄.
#[derive(Debug)]
pub struct Backward<'a, T> {
    pub layer: &'a Attenuated<T>,
    pub part: &'a Part<'a>,
    pub x: &'a [T],
    pub u: &'a [T],
    pub y_bar: &'a [T],
    pub x_bar: &'a mut [T],
    pub s_bar: &'a mut [T],
}

impl<T: Real> WithSimd for Backward<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { layer, part, x, u, y_bar, x_bar, s_bar } = self;
        let Attenuated { inputs, outputs, ref a, .. } = *layer;
        let (width, one) = (layer.width(), Lanes::splat(simd, T::ONE));
        for r in 0..part.rows {
            let y_bar = &y_bar[r * outputs..][..outputs];
            for i in part.wanted(r) {
                let (at, x) = (part.at(r, i, width), Lanes::splat(simd, x[r * inputs + i]));
                let [u, a] = line(simd, [&u[at..], &a[i * width..]], width);
                let [s_bar] = line_mut(simd, [&mut s_bar[at..]], width);
                let mut sum = Lanes::splat(simd, T::ZERO);
                for (w, s_bar) in s_bar.iter_mut().enumerate() {
                    let [u, a] = Lanes::each(simd, [u[w], a[w]]);
                    let open = of(simd, y_bar, w) * u * a;
                    sum = sum + open;
                    *s_bar = (open * (one - u) * x).values();
                }
                x_bar[r * inputs + i] += sum.sum();
            }
        }
    }
}

/// Adds to ẏ.
#[derive(Debug)]
pub struct Tangent<'a, T> {
    pub layer: &'a Attenuated<T>,
    pub part: &'a Part<'a>,
    pub x: &'a [T],
    pub x_dot: &'a [T],
    pub u: &'a [T],
    pub s_dot: &'a [T],
    pub y_dot: &'a mut [T],
}

impl<T: Real> WithSimd for Tangent<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { layer, part, x, x_dot, u, s_dot, y_dot } = self;
        let Attenuated { inputs, outputs, ref a, .. } = *layer;
        let (width, count, one) = (layer.width(), Lanes::<S, T>::COUNT, Lanes::splat(simd, T::ONE));
        for r in 0..part.rows {
            let [x, x_dot] = [x, x_dot].map(|x| &x[r * inputs..][..inputs]);
            for (w, y_dot) in y_dot[r * outputs..][..outputs].chunks_mut(count).enumerate() {
                let mut sum = Lanes::load(simd, y_dot);
                for i in part.wanted(r) {
                    let at = part.at(r, i, width) + w * count;
                    let [u, s_dot, a] = Lanes::load_each(simd, [&u[at..], &s_dot[at..], &a[i * width + w * count..]]);
                    let (x, x_dot) = (Lanes::splat(simd, x[i]), Lanes::splat(simd, x_dot[i]));
                    sum = (a * u).mul_add(((one - u) * s_dot).mul_add(x, x_dot), sum);
                }
                sum.store(y_dot);
            }
        }
    }
}

/// Adds to x̂ and to the gradient; ŝ: the terms of ŷ.
#[derive(Debug)]
pub struct FirstAdjoint<'a, T> {
    pub layer: &'a Attenuated<T>,
    pub part: &'a Part<'a>,
    pub x: &'a [T],
    pub u: &'a [T],
    pub y_hat: &'a [T],
    pub x_hat: &'a mut [T],
    pub s_hat: &'a mut [T],
    pub in_a: &'a mut [T],
}

impl<T: Real> WithSimd for FirstAdjoint<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { layer, part, x, u, y_hat, x_hat, s_hat, in_a } = self;
        let Attenuated { inputs, outputs, ref a, .. } = *layer;
        let (width, one) = (layer.width(), Lanes::splat(simd, T::ONE));
        for r in 0..part.rows {
            let y_hat = &y_hat[r * outputs..][..outputs];
            for i in part.wanted(r) {
                let (at, x) = (part.at(r, i, width), Lanes::splat(simd, x[r * inputs + i]));
                let [u, a] = line(simd, [&u[at..], &a[i * width..]], width);
                let [s_hat, in_a] = line_mut(simd, [&mut s_hat[at..], &mut in_a[i * width..]], width);
                let mut sum = Lanes::splat(simd, T::ZERO);
                for w in 0..u.len() {
                    let [u, a, in_weight] = Lanes::each(simd, [u[w], a[w], in_a[w]]);
                    let open = of(simd, y_hat, w) * u;
                    sum = open.mul_add(a, sum);
                    let open = open * x;
                    in_a[w] = (in_weight + open).values();
                    s_hat[w] = (open * (one - u) * a).values();
                }
                x_hat[r * inputs + i] += sum.sum();
            }
        }
    }
}

/// Adds to x̂ and to the gradient; ŝ and s̄: the terms of ŷ and of ȳ.
#[derive(Debug)]
pub struct SecondAdjoint<'a, T> {
    pub layer: &'a Attenuated<T>,
    pub part: &'a Part<'a>,
    /// x and ẋ.
    pub xs: (&'a [T], &'a [T]),
    pub u: &'a [T],
    pub s_dot: &'a [T],
    /// ŷ and ȳ.
    pub ys: (&'a [T], &'a [T]),
    pub x_hat: &'a mut [T],
    /// ŝ and s̄.
    pub ss: (&'a mut [T], &'a mut [T]),
    pub in_a: &'a mut [T],
}

impl<T: Real> WithSimd for SecondAdjoint<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { layer, part, xs, u, s_dot, ys, x_hat, ss, in_a } = self;
        let Attenuated { inputs, outputs, ref a, .. } = *layer;
        let (width, one) = (layer.width(), Lanes::splat(simd, T::ONE));
        for r in 0..part.rows {
            let [y_hat, y_bar] = [ys.0, ys.1].map(|y| &y[r * outputs..][..outputs]);
            for i in part.wanted(r) {
                let at = part.at(r, i, width);
                let of_row = r * inputs + i;
                let (x, x_dot) = (Lanes::splat(simd, xs.0[of_row]), Lanes::splat(simd, xs.1[of_row]));
                let [u, s_dot, a] = line(simd, [&u[at..], &s_dot[at..], &a[i * width..]], width);
                let [s_hat, s_bar, in_a] =
                    line_mut(simd, [&mut ss.0[at..], &mut ss.1[at..], &mut in_a[i * width..]], width);
                let mut sum = Lanes::splat(simd, T::ZERO);
                for w in 0..u.len() {
                    let [u, s_dot, a, in_weight] = Lanes::each(simd, [u[w], s_dot[w], a[w], in_a[w]]);
                    let (y_hat, y_bar) = (of(simd, y_hat, w), of(simd, y_bar, w));
                    let shut = one - u;
                    let slope = u * shut;
                    let moved = y_bar * s_dot;
                    let (p, q) = (y_hat.mul_add(x, y_bar * x_dot), moved * x);
                    sum = a.mul_add(y_hat.mul_add(u, moved * slope), sum);
                    in_a[w] = (u.mul_add(p, slope.mul_add(q, in_weight))).values();
                    let slope = a * slope;
                    s_hat[w] = (slope * (shut - u).mul_add(q, p)).values();
                    s_bar[w] = (slope * y_bar * x).values();
                }
                x_hat[r * inputs + i] += sum.sum();
            }
        }
    }
}

/// The registers of one input.
#[inline(always)]
fn line<S: Simd, T: Real, const N: usize>(simd: S, slices: [&[T]; N], width: usize) -> [&[T::Lanes<S>]; N] {
    registers(simd, slices, width / Lanes::<S, T>::COUNT)
}

/// The same, to be written.
#[inline(always)]
fn line_mut<S: Simd, T: Real, const N: usize>(simd: S, slices: [&mut [T]; N], width: usize) -> [&mut [T::Lanes<S>]; N] {
    registers_mut(simd, slices, width / Lanes::<S, T>::COUNT)
}

/// Register w of a row of O numbers, with zeros behind its end.
#[inline(always)]
fn of<S: Simd, T: Real>(simd: S, row: &[T], w: usize) -> Lanes<S, T> {
    Lanes::load(simd, &row[w * Lanes::<S, T>::COUNT..])
}
