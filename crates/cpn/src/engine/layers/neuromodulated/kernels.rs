//! Kernels of the passes over gated weights. The formulas are in [`layer`](super::layer).
//!
//! Each kernel runs over R samples and a range of the inputs. `a` and `in_a` are `[inputs, O']`; u and s with their tangents and
//! gradients are `[R, inputs of the range, O']`; x is `[R, inputs]` and y `[R, O]`.

use super::block_sparse::{BlockRange, Epilogue};
use crate::engine::layers::passes::{Cotangent, Primal};
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::{Vector, registers, registers_mut};
use pulp::{Simd, WithSimd};

/// View of the attenuated weights.
#[derive(Debug, Clone, Copy)]
pub struct WeightsView<'a, T> {
    /// I, the number of inputs.
    pub inputs: usize,
    /// O, the number of outputs.
    pub outputs: usize,
    /// O', O rounded up to whole registers.
    pub width: usize,
    /// a, `[I, O']`.
    pub a: &'a [T],
}

impl<T: Element> WeightsView<'_, T> {
    /// Number of registers of O'.
    #[inline(always)]
    fn registers<S: Simd>(&self) -> usize {
        self.width / Vector::<S, T>::COUNT
    }
}

/// Forward pass, as an epilogue of the gate: writes u = σ(s), and adds to y.
#[derive(Debug)]
pub struct Forward<'a, T> {
    pub weights: WeightsView<'a, T>,
    pub range: &'a BlockRange<'a>,
    pub x: &'a [T],
    pub u: &'a mut [T],
    pub y: &'a mut [T],
}

impl<T: Element> Epilogue<T> for Forward<'_, T> {
    #[inline(always)]
    fn apply<S: Simd, const P: usize, const W: usize>(
        &mut self,
        simd: S,
        r: usize,
        blocks: [usize; P],
        tile: usize,
        s: [[Vector<S, T>; W]; P],
    ) {
        let Self { weights, range, x, u, y } = self;
        let WeightsView { inputs, outputs, width, a } = *weights;
        let (x, y, at) = (&x[r * inputs..][..inputs], &mut y[r * outputs..][..outputs], tile * W);
        let mut sums = load::<S, T, W>(simd, y, at);
        for (i, s) in blocks.into_iter().zip(s) {
            let [a] = tile_of::<S, T, W, 1>(simd, [&a[i * width..]], at);
            let [u] = tile_of_mut::<S, T, W, 1>(simd, [&mut u[range.offset(r, i, width)..]], at);
            let x = Vector::splat(simd, x[i]);
            for (w, (sum, s)) in sums.iter_mut().zip(s).enumerate() {
                let ([a], gate) = (Vector::from_registers(simd, [a[w]]), s.sigmoid());
                u[w] = gate.register();
                *sum = (gate * a).mul_add(x, *sum);
            }
        }
        store(sums, y, at);
    }
}

/// Backward pass (vjp): adds to x̄, and writes s̄.
#[derive(Debug)]
pub struct Vjp<'a, T> {
    pub weights: WeightsView<'a, T>,
    pub range: &'a BlockRange<'a>,
    pub x: &'a [T],
    pub u: &'a [T],
    pub y_bar: &'a [T],
    pub x_bar: &'a mut [T],
    pub s_bar: &'a mut [T],
}

impl<T: Element> WithSimd for Vjp<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (rows, registers) = (self.range.rows, self.weights.registers::<S>());
        for_each_tile(simd, &mut self, rows, registers);
    }
}

impl<S: Simd, T: Element> OutputTiles<S> for Vjp<'_, T> {
    #[inline(always)]
    fn tile<const W: usize>(&mut self, simd: S, r: usize, at: usize) {
        let Self { weights, range, x, u, y_bar, x_bar, s_bar } = self;
        let WeightsView { inputs, outputs, width, a } = *weights;
        let one = Vector::splat(simd, T::ONE);
        let y_bar = load::<S, T, W>(simd, &y_bar[r * outputs..][..outputs], at);
        let (x, x_bar) = (&x[r * inputs..][..inputs], &mut x_bar[r * inputs..][..inputs]);
        for i in range.active_blocks(r) {
            let offset = range.offset(r, i, width);
            let [u, a] = tile_of::<S, T, W, 2>(simd, [&u[offset..], &a[i * width..]], at);
            let [s_bar] = tile_of_mut::<S, T, W, 1>(simd, [&mut s_bar[offset..]], at);
            let (x, mut sum) = (Vector::splat(simd, x[i]), Vector::splat(simd, T::ZERO));
            for (w, y_bar) in y_bar.into_iter().enumerate() {
                let [u, a] = Vector::from_registers(simd, [u[w], a[w]]);
                let gated = y_bar * u * a;
                sum = sum + gated;
                s_bar[w] = (gated * (one - u) * x).register();
            }
            x_bar[i] += sum.sum();
        }
    }
}

/// Tangent pass (jvp), as an epilogue of the gate: writes ṡ, and adds to ẏ.
#[derive(Debug)]
pub struct Jvp<'a, T> {
    pub weights: WeightsView<'a, T>,
    pub range: &'a BlockRange<'a>,
    pub x: &'a [T],
    pub x_dot: &'a [T],
    pub u: &'a [T],
    pub s_dot: &'a mut [T],
    pub y_dot: &'a mut [T],
}

impl<T: Element> Epilogue<T> for Jvp<'_, T> {
    #[inline(always)]
    fn apply<S: Simd, const P: usize, const W: usize>(
        &mut self,
        simd: S,
        r: usize,
        blocks: [usize; P],
        tile: usize,
        s: [[Vector<S, T>; W]; P],
    ) {
        let Self { weights, range, x, x_dot, u, s_dot, y_dot } = self;
        let WeightsView { inputs, outputs, width, a } = *weights;
        let (y_dot, at) = (&mut y_dot[r * outputs..][..outputs], tile * W);
        let [x, x_dot] = [*x, *x_dot].map(|x| &x[r * inputs..][..inputs]);
        let (mut sums, one) = (load::<S, T, W>(simd, y_dot, at), Vector::splat(simd, T::ONE));
        for (i, s) in blocks.into_iter().zip(s) {
            let offset = range.offset(r, i, width);
            let [u, a] = tile_of::<S, T, W, 2>(simd, [&u[offset..], &a[i * width..]], at);
            let [s_dot] = tile_of_mut::<S, T, W, 1>(simd, [&mut s_dot[offset..]], at);
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

/// Backward pass of Φ in the first order, with the terms of ŷ: adds to x̂ and to the gradient in a, and writes ŝ.
#[derive(Debug)]
pub struct FirstOrderBackward<'a, T> {
    pub weights: WeightsView<'a, T>,
    pub range: &'a BlockRange<'a>,
    pub x: &'a [T],
    pub u: &'a [T],
    pub y_hat: &'a [T],
    pub x_hat: &'a mut [T],
    pub s_hat: &'a mut [T],
    pub in_a: &'a mut [T],
}

impl<T: Element> WithSimd for FirstOrderBackward<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (rows, registers) = (self.range.rows, self.weights.registers::<S>());
        for_each_tile(simd, &mut self, rows, registers);
    }
}

impl<S: Simd, T: Element> OutputTiles<S> for FirstOrderBackward<'_, T> {
    #[inline(always)]
    fn tile<const W: usize>(&mut self, simd: S, r: usize, at: usize) {
        let Self { weights, range, x, u, y_hat, x_hat, s_hat, in_a } = self;
        let WeightsView { inputs, outputs, width, a } = *weights;
        let one = Vector::splat(simd, T::ONE);
        let y_hat = load::<S, T, W>(simd, &y_hat[r * outputs..][..outputs], at);
        let (x, x_hat) = (&x[r * inputs..][..inputs], &mut x_hat[r * inputs..][..inputs]);
        for i in range.active_blocks(r) {
            let offset = range.offset(r, i, width);
            let [u, a] = tile_of::<S, T, W, 2>(simd, [&u[offset..], &a[i * width..]], at);
            let [s_hat, in_a] = tile_of_mut::<S, T, W, 2>(simd, [&mut s_hat[offset..], &mut in_a[i * width..]], at);
            let (x, mut sum) = (Vector::splat(simd, x[i]), Vector::splat(simd, T::ZERO));
            for (w, y_hat) in y_hat.into_iter().enumerate() {
                let [u, a, in_weight] = Vector::from_registers(simd, [u[w], a[w], in_a[w]]);
                let gated = y_hat * u;
                sum = gated.mul_add(a, sum);
                let gated = gated * x;
                in_a[w] = (in_weight + gated).register();
                s_hat[w] = (gated * (one - u) * a).register();
            }
            x_hat[i] += sum.sum();
        }
    }
}

/// Backward pass of Φ in the second order, with the terms of ŷ and ȳ: adds to x̂ and to the gradient in a, and writes ŝ and s̄.
#[derive(Debug)]
pub struct SecondOrderBackward<'a, T> {
    pub weights: WeightsView<'a, T>,
    pub range: &'a BlockRange<'a>,
    pub primal: Primal<'a, T>,
    pub u: &'a [T],
    pub s_dot: &'a [T],
    pub cotangent: Cotangent<'a, T>,
    pub x_hat: &'a mut [T],
    pub s_hat: &'a mut [T],
    pub s_bar: &'a mut [T],
    pub in_a: &'a mut [T],
}

impl<T: Element> WithSimd for SecondOrderBackward<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (rows, registers) = (self.range.rows, self.weights.registers::<S>());
        for_each_tile(simd, &mut self, rows, registers);
    }
}

impl<S: Simd, T: Element> OutputTiles<S> for SecondOrderBackward<'_, T> {
    #[inline(always)]
    fn tile<const W: usize>(&mut self, simd: S, r: usize, at: usize) {
        let Self { weights, range, primal, u, s_dot, cotangent, x_hat, s_hat, s_bar, in_a } = self;
        let WeightsView { inputs, outputs, width, a } = *weights;
        let one = Vector::splat(simd, T::ONE);
        let y_hat = load::<S, T, W>(simd, &cotangent.y_hat[r * outputs..][..outputs], at);
        let y_bar = load::<S, T, W>(simd, &cotangent.y_bar[r * outputs..][..outputs], at);
        let [x, x_dot] = [primal.x, primal.x_dot].map(|x| &x[r * inputs..][..inputs]);
        let x_hat = &mut x_hat[r * inputs..][..inputs];

        for i in range.active_blocks(r) {
            let offset = range.offset(r, i, width);
            let [u, s_dot, a] = tile_of::<S, T, W, 3>(simd, [&u[offset..], &s_dot[offset..], &a[i * width..]], at);
            let to = [&mut s_hat[offset..], &mut s_bar[offset..], &mut in_a[i * width..]];
            let [s_hat, s_bar, in_a] = tile_of_mut::<S, T, W, 3>(simd, to, at);
            let (x, x_dot) = (Vector::splat(simd, x[i]), Vector::splat(simd, x_dot[i]));
            let mut sum = Vector::splat(simd, T::ZERO);
            for w in 0..W {
                let [u, s_dot, a, in_weight] = Vector::from_registers(simd, [u[w], s_dot[w], a[w], in_a[w]]);
                let (y_hat, y_bar) = (y_hat[w], y_bar[w]);
                // u' = u (1 - u), u'' = u' (1 - 2 u).
                let complement = one - u;
                let slope = u * complement;
                let moved = y_bar * s_dot;
                let (p, q) = (y_hat.mul_add(x, y_bar * x_dot), moved * x);
                sum = a.mul_add(y_hat.mul_add(u, moved * slope), sum);
                in_a[w] = (u.mul_add(p, slope.mul_add(q, in_weight))).register();
                let slope = a * slope;
                s_hat[w] = (slope * (complement - u).mul_add(q, p)).register();
                s_bar[w] = (slope * y_bar * x).register();
            }
            x_hat[i] += sum.sum();
        }
    }
}

/// A pass over the outputs of each row, W registers at a time, with an inner loop over the inputs.
trait OutputTiles<S: Simd> {
    /// The outputs of row r from register `at` on.
    fn tile<const W: usize>(&mut self, simd: S, r: usize, at: usize);
}

/// Runs a pass over all tiles of all rows.
#[inline(always)]
fn for_each_tile<S: Simd>(simd: S, pass: &mut impl OutputTiles<S>, rows: usize, registers: usize) {
    for r in 0..rows {
        let mut at = 0;
        while at + 4 <= registers {
            pass.tile::<4>(simd, r, at);
            at += 4;
        }
        while at + 2 <= registers {
            pass.tile::<2>(simd, r, at);
            at += 2;
        }
        while at < registers {
            pass.tile::<1>(simd, r, at);
            at += 1;
        }
    }
}

/// Loads W registers of a row of O elements, from register `at` on, with zeros past its end.
#[inline(always)]
fn load<S: Simd, T: Element, const W: usize>(simd: S, row: &[T], at: usize) -> [Vector<S, T>; W] {
    let mut values = [Vector::splat(simd, T::ZERO); W];
    for (w, values) in values.iter_mut().enumerate() {
        *values = Vector::load(simd, &row[(at + w) * Vector::<S, T>::COUNT..]);
    }
    values
}

/// Stores W registers of a row from register `at` on.
#[inline(always)]
fn store<S: Simd, T: Element, const W: usize>(values: [Vector<S, T>; W], row: &mut [T], at: usize) {
    for (w, values) in values.into_iter().enumerate() {
        values.store(&mut row[(at + w) * Vector::<S, T>::COUNT..]);
    }
}

/// W registers of each slice, from register `at` on.
#[inline(always)]
fn tile_of<S: Simd, T: Element, const W: usize, const N: usize>(
    simd: S,
    slices: [&[T]; N],
    at: usize,
) -> [&[T::Register<S>]; N] {
    registers(simd, slices, at + W).map(|slice| &slice[at..])
}

/// Mutable [`tile_of`].
#[inline(always)]
fn tile_of_mut<S: Simd, T: Element, const W: usize, const N: usize>(
    simd: S,
    slices: [&mut [T]; N],
    at: usize,
) -> [&mut [T::Register<S>]; N] {
    registers_mut(simd, slices, at + W).map(|slice| &mut slice[at..])
}
