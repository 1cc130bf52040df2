//! What the passes over attenuated weights do for each of them. The formulas stand in [`gated`](super::gated).
//!
//! Each kernel runs over R samples and a part of the inputs; `a` is `[inputs, O']`, what belongs to u is `[R, some inputs, O']`,
//! the rest `[R, inputs]` or `[R, O]`.

use super::attenuated::Attenuated;
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::{Vector, registers, registers_mut};
use super::sparse::{Part, Taker};
use pulp::{Simd, WithSimd};

/// Adds to y; leaves u of s, as that comes.
#[derive(Debug)]
pub struct Forward<'a, T> {
    pub layer: &'a Attenuated<T>,
    pub part: &'a Part<'a>,
    pub x: &'a [T],
    pub u: &'a mut [T],
    pub y: &'a mut [T],
}

impl<T: Element> Taker<T> for Forward<'_, T> {
    #[inline(always)]
    fn take<S: Simd, const P: usize, const W: usize>(
        &mut self,
        simd: S,
        r: usize,
        blocks: [usize; P],
        tile: usize,
        s: [[Vector<S, T>; W]; P],
    ) {
        let Self { layer, part, x, u, y } = self;
        let Attenuated { inputs, outputs, ref a, .. } = **layer;
        let (x, y, width, at) = (&x[r * inputs..][..inputs], &mut y[r * outputs..][..outputs], layer.width(), tile * W);
        let mut sums = load::<S, T, W>(simd, y, at);
        for (i, s) in blocks.into_iter().zip(s) {
            let [a] = line::<S, T, W, 1>(simd, [&a[i * width..]], at);
            let [u] = line_mut::<S, T, W, 1>(simd, [&mut u[part.at(r, i, width)..]], at);
            let x = Vector::splat(simd, x[i]);
            for (w, (sum, s)) in sums.iter_mut().zip(s).enumerate() {
                let ([a], open) = (Vector::from_registers(simd, [a[w]]), s.sigmoid());
                u[w] = open.register();
                *sum = (open * a).mul_add(x, *sum);
            }
        }
        store(sums, y, at);
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

impl<T: Element> WithSimd for Backward<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (rows, registers) = (self.part.rows, self.layer.registers::<S>());
        outputs(simd, &mut self, rows, registers);
    }
}

impl<S: Simd, T: Element> Outputs<S> for Backward<'_, T> {
    #[inline(always)]
    fn some<const W: usize>(&mut self, simd: S, r: usize, at: usize) {
        let Self { layer, part, x, u, y_bar, x_bar, s_bar } = self;
        let Attenuated { inputs, outputs, ref a, .. } = **layer;
        let (width, one) = (layer.width(), Vector::splat(simd, T::ONE));
        let y_bar = load::<S, T, W>(simd, &y_bar[r * outputs..][..outputs], at);
        let (x, x_bar) = (&x[r * inputs..][..inputs], &mut x_bar[r * inputs..][..inputs]);
        for i in part.wanted(r) {
            let place = part.at(r, i, width);
            let [u, a] = line::<S, T, W, 2>(simd, [&u[place..], &a[i * width..]], at);
            let [s_bar] = line_mut::<S, T, W, 1>(simd, [&mut s_bar[place..]], at);
            let (x, mut sum) = (Vector::splat(simd, x[i]), Vector::splat(simd, T::ZERO));
            for (w, y_bar) in y_bar.into_iter().enumerate() {
                let [u, a] = Vector::from_registers(simd, [u[w], a[w]]);
                let open = y_bar * u * a;
                sum = sum + open;
                s_bar[w] = (open * (one - u) * x).register();
            }
            x_bar[i] += sum.sum();
        }
    }
}

/// Adds to ẏ; leaves ṡ, as that comes.
#[derive(Debug)]
pub struct Tangent<'a, T> {
    pub layer: &'a Attenuated<T>,
    pub part: &'a Part<'a>,
    pub x: &'a [T],
    pub x_dot: &'a [T],
    pub u: &'a [T],
    pub s_dot: &'a mut [T],
    pub y_dot: &'a mut [T],
}

impl<T: Element> Taker<T> for Tangent<'_, T> {
    #[inline(always)]
    fn take<S: Simd, const P: usize, const W: usize>(
        &mut self,
        simd: S,
        r: usize,
        blocks: [usize; P],
        tile: usize,
        s: [[Vector<S, T>; W]; P],
    ) {
        let Self { layer, part, x, x_dot, u, s_dot, y_dot } = self;
        let Attenuated { inputs, outputs, ref a, .. } = **layer;
        let (y_dot, width, at) = (&mut y_dot[r * outputs..][..outputs], layer.width(), tile * W);
        let [x, x_dot] = [*x, *x_dot].map(|x| &x[r * inputs..][..inputs]);
        let (mut sums, one) = (load::<S, T, W>(simd, y_dot, at), Vector::splat(simd, T::ONE));
        for (i, s) in blocks.into_iter().zip(s) {
            let place = part.at(r, i, width);
            let [u, a] = line::<S, T, W, 2>(simd, [&u[place..], &a[i * width..]], at);
            let [s_dot] = line_mut::<S, T, W, 1>(simd, [&mut s_dot[place..]], at);
            let (x, x_dot) = (Vector::splat(simd, x[i]), Vector::splat(simd, x_dot[i]));
            for (w, (sum, s)) in sums.iter_mut().zip(s).enumerate() {
                let [u, a] = Vector::from_registers(simd, [u[w], a[w]]);
                s_dot[w] = s.register();
                *sum = (a * u).mul_add(((one - u) * s).mul_add(x, x_dot), *sum);
            }
        }
        store(sums, y_dot, at);
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

impl<T: Element> WithSimd for FirstAdjoint<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (rows, registers) = (self.part.rows, self.layer.registers::<S>());
        outputs(simd, &mut self, rows, registers);
    }
}

impl<S: Simd, T: Element> Outputs<S> for FirstAdjoint<'_, T> {
    #[inline(always)]
    fn some<const W: usize>(&mut self, simd: S, r: usize, at: usize) {
        let Self { layer, part, x, u, y_hat, x_hat, s_hat, in_a } = self;
        let Attenuated { inputs, outputs, ref a, .. } = **layer;
        let (width, one) = (layer.width(), Vector::splat(simd, T::ONE));
        let y_hat = load::<S, T, W>(simd, &y_hat[r * outputs..][..outputs], at);
        let (x, x_hat) = (&x[r * inputs..][..inputs], &mut x_hat[r * inputs..][..inputs]);
        for i in part.wanted(r) {
            let place = part.at(r, i, width);
            let [u, a] = line::<S, T, W, 2>(simd, [&u[place..], &a[i * width..]], at);
            let [s_hat, in_a] = line_mut::<S, T, W, 2>(simd, [&mut s_hat[place..], &mut in_a[i * width..]], at);
            let (x, mut sum) = (Vector::splat(simd, x[i]), Vector::splat(simd, T::ZERO));
            for (w, y_hat) in y_hat.into_iter().enumerate() {
                let [u, a, in_weight] = Vector::from_registers(simd, [u[w], a[w], in_a[w]]);
                let open = y_hat * u;
                sum = open.mul_add(a, sum);
                let open = open * x;
                in_a[w] = (in_weight + open).register();
                s_hat[w] = (open * (one - u) * a).register();
            }
            x_hat[i] += sum.sum();
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

impl<T: Element> WithSimd for SecondAdjoint<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (rows, registers) = (self.part.rows, self.layer.registers::<S>());
        outputs(simd, &mut self, rows, registers);
    }
}

impl<S: Simd, T: Element> Outputs<S> for SecondAdjoint<'_, T> {
    #[inline(always)]
    fn some<const W: usize>(&mut self, simd: S, r: usize, at: usize) {
        let Self { layer, part, xs, u, s_dot, ys, x_hat, ss, in_a } = self;
        let Attenuated { inputs, outputs, ref a, .. } = **layer;
        let (width, one) = (layer.width(), Vector::splat(simd, T::ONE));
        let y_hat = load::<S, T, W>(simd, &ys.0[r * outputs..][..outputs], at);
        let y_bar = load::<S, T, W>(simd, &ys.1[r * outputs..][..outputs], at);
        let [x, x_dot] = [xs.0, xs.1].map(|x| &x[r * inputs..][..inputs]);
        let x_hat = &mut x_hat[r * inputs..][..inputs];
        for i in part.wanted(r) {
            let place = part.at(r, i, width);
            let [u, s_dot, a] = line::<S, T, W, 3>(simd, [&u[place..], &s_dot[place..], &a[i * width..]], at);
            let to = [&mut ss.0[place..], &mut ss.1[place..], &mut in_a[i * width..]];
            let [s_hat, s_bar, in_a] = line_mut::<S, T, W, 3>(simd, to, at);
            let (x, x_dot) = (Vector::splat(simd, x[i]), Vector::splat(simd, x_dot[i]));
            let mut sum = Vector::splat(simd, T::ZERO);
            for w in 0..W {
                let [u, s_dot, a, in_weight] = Vector::from_registers(simd, [u[w], s_dot[w], a[w], in_a[w]]);
                let (y_hat, y_bar) = (y_hat[w], y_bar[w]);
                let shut = one - u;
                let slope = u * shut;
                let moved = y_bar * s_dot;
                let (p, q) = (y_hat.mul_add(x, y_bar * x_dot), moved * x);
                sum = a.mul_add(y_hat.mul_add(u, moved * slope), sum);
                in_a[w] = (u.mul_add(p, slope.mul_add(q, in_weight))).register();
                let slope = a * slope;
                s_hat[w] = (slope * (shut - u).mul_add(q, p)).register();
                s_bar[w] = (slope * y_bar * x).register();
            }
            x_hat[i] += sum.sum();
        }
    }
}

/// What goes through the outputs of each row, W registers of them at a time, and through the inputs for each.
trait Outputs<S: Simd> {
    /// Those of row r from register `at` on.
    fn some<const W: usize>(&mut self, simd: S, r: usize, at: usize);
}

#[inline(always)]
fn outputs<S: Simd>(simd: S, pass: &mut impl Outputs<S>, rows: usize, registers: usize) {
    for r in 0..rows {
        let mut at = 0;
        while at + 4 <= registers {
            pass.some::<4>(simd, r, at);
            at += 4;
        }
        while at + 2 <= registers {
            pass.some::<2>(simd, r, at);
            at += 2;
        }
        while at < registers {
            pass.some::<1>(simd, r, at);
            at += 1;
        }
    }
}

/// W registers of a row of O numbers, from register `at` on, with zeros behind its end.
#[inline(always)]
fn load<S: Simd, T: Element, const W: usize>(simd: S, row: &[T], at: usize) -> [Vector<S, T>; W] {
    let mut values = [Vector::splat(simd, T::ZERO); W];
    for (w, values) in values.iter_mut().enumerate() {
        *values = Vector::load(simd, &row[(at + w) * Vector::<S, T>::COUNT..]);
    }
    values
}

/// Writes them over.
#[inline(always)]
fn store<S: Simd, T: Element, const W: usize>(values: [Vector<S, T>; W], row: &mut [T], at: usize) {
    for (w, values) in values.into_iter().enumerate() {
        values.store(&mut row[(at + w) * Vector::<S, T>::COUNT..]);
    }
}

/// W registers of each slice, from register `at` on.
#[inline(always)]
fn line<S: Simd, T: Element, const W: usize, const N: usize>(
    simd: S,
    slices: [&[T]; N],
    at: usize,
) -> [&[T::Register<S>]; N] {
    registers(simd, slices, at + W).map(|slice| &slice[at..])
}

/// The same, to be written.
#[inline(always)]
fn line_mut<S: Simd, T: Element, const W: usize, const N: usize>(
    simd: S,
    slices: [&mut [T]; N],
    at: usize,
) -> [&mut [T::Register<S>]; N] {
    registers_mut(simd, slices, at + W).map(|slice| &mut slice[at..])
}
