//! A linear layer of which each row takes some inputs and wants some outputs: the others are neither read nor written.
//!
//! Its inputs are what a rectified linear unit left, about half of them zero. Its outputs come in blocks of O; a block is not
//! wanted where what it would be multiplied by is zero.

use super::rectified::Open;
use super::simd::vector;
use crate::engine::simd::buffer::{AlignedVec, resize, zeros};
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::{Vector, VectorShape, registers, registers_mut};
use pulp::{Arch, Simd, WithSimd};
use std::ops::Range;

/// The layer's weights. O' is O rounded up to whole registers; what is beyond O is zero.
#[derive(Debug)]
pub struct Sparse<T> {
    /// K.
    pub inputs: usize,
    /// O'.
    pub width: usize,
    /// O.
    outputs: usize,
    /// `[blocks, K, O']`.
    weight: AlignedVec<T>,
    /// `[blocks, O']`.
    bias: AlignedVec<T>,
    /// As many.
    zeros: AlignedVec<T>,
}

/// What a loss changes by when the weights do, likewise.
#[derive(Debug)]
pub struct SparseGradient<T> {
    pub weight: AlignedVec<T>,
    pub bias: AlignedVec<T>,
}

/// Some blocks, for R = `rows` rows.
#[derive(Debug, Clone)]
pub struct Part<'a> {
    pub rows: usize,
    pub blocks: Range<usize>,
    /// Which of them each row wants.
    pub wanted: &'a Open,
}

impl<'a> Part<'a> {
    /// What row r wants.
    #[inline(always)]
    pub fn wanted(&self, r: usize) -> impl Iterator<Item = usize> + use<'a> {
        self.wanted.row(self.blocks.start, r).iter().map(|block| *block as usize)
    }

    /// Where a block of row r begins among the part's blocks of O', row by row.
    #[inline(always)]
    pub fn at(&self, r: usize, block: usize, width: usize) -> usize {
        (r * self.blocks.len() + block - self.blocks.start) * width
    }
}

/// O rounded up to whole registers.
pub fn padded<T: Element>(outputs: usize) -> usize {
    outputs.next_multiple_of(VectorShape::of::<T>().lanes)
}

impl<T: Element> Sparse<T> {
    /// Of a weight `[O, blocks, K]` and a bias `[O, blocks]`.
    pub fn new(weight: &[T], bias: &[T], outputs: usize) -> Self {
        let (blocks, inputs, width) = (bias.len() / outputs, weight.len() / bias.len(), padded::<T>(outputs));
        let mut layer = Self {
            inputs,
            width,
            outputs,
            weight: zeros(blocks * inputs * width),
            bias: zeros(blocks * width),
            zeros: zeros(blocks * width),
        };
        for (i, block) in layer.weight.chunks_exact_mut(inputs * width).enumerate() {
            let rows: Vec<_> = (0..outputs).map(|o| &weight[(o * blocks + i) * inputs..][..inputs]).collect();
            for (k, line) in block.chunks_exact_mut(width).enumerate() {
                for (value, row) in line.iter_mut().zip(&rows) {
                    *value = row[k];
                }
            }
        }
        for (i, line) in layer.bias.chunks_exact_mut(width).enumerate() {
            for (o, value) in line[..outputs].iter_mut().enumerate() {
                *value = bias[o * blocks + i];
            }
        }
        layer
    }

    /// How many blocks.
    pub fn blocks(&self) -> usize {
        self.bias.len() / self.width
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> SparseGradient<T> {
        SparseGradient { weight: zeros(self.weight.len()), bias: zeros(self.bias.len()) }
    }

    /// y = a x + b of a part: x `[R, K]`, where it is open; y is taken as it comes.
    pub fn forward(&self, part: &Part<'_>, open: &Open, x: &[T], taker: &mut impl Taker<T>) {
        Arch::new().dispatch(Forward { layer: self, part, open, bias: &self.bias, x, taker });
    }

    /// ẏ = a ẋ of a part, likewise.
    pub fn tangent(&self, part: &Part<'_>, open: &Open, x_dot: &[T], taker: &mut impl Taker<T>) {
        Arch::new().dispatch(Forward { layer: self, part, open, bias: &self.zeros, x: x_dot, taker });
    }

    /// x̄ `[R, K]` of ȳ, which comes part by part, `[R, its blocks, O']`: the first begins anew, and after the last it is
    /// there. Until then `sums` has a register for each x̄ that is open, whose lanes are added up once for all parts.
    pub fn backward(&self, part: &Part<'_>, open: &Open, y_bar: &[T], sums: &mut AlignedVec<T>, x_bar: &mut [T]) {
        let sums = resize(sums, part.rows * self.inputs * VectorShape::of::<T>().lanes);
        Arch::new().dispatch(Backward { layer: self, part, open, y_bar, sums });
        if part.blocks.end == self.blocks() {
            Arch::new().dispatch(AddUp { inputs: self.inputs, open, sums, x_bar });
        }
    }

    /// Adds to the gradient what ŷ and, in the second order, ȳ of a part give, from x and ẋ.
    pub fn accumulate(
        &self,
        part: &Part<'_>,
        open: &Open,
        (x, y_hat): (&[T], &[T]),
        second: Option<(&[T], &[T])>,
        gradient: &mut SparseGradient<T>,
    ) {
        let first = (x, y_hat);
        match second {
            Some(second) => {
                Arch::new().dispatch(Accumulate::<T, true> { layer: self, part, open, first, second, gradient })
            }
            None => {
                Arch::new().dispatch(Accumulate::<T, false> { layer: self, part, open, first, second: first, gradient })
            }
        }
    }

    /// A gradient as the weights are given: `[O, blocks, K]` and `[O, blocks]`.
    pub fn in_weights(&self, gradient: &SparseGradient<T>) -> [Vec<T>; 2] {
        let (&Self { inputs, width, outputs, .. }, blocks) = (self, self.blocks());
        let mut weight = vec![T::ZERO; outputs * blocks * inputs];
        for (i, block) in gradient.weight.chunks_exact(inputs * width).enumerate() {
            for o in 0..outputs {
                for (k, value) in weight[(o * blocks + i) * inputs..][..inputs].iter_mut().enumerate() {
                    *value = block[k * width + o];
                }
            }
        }
        let bias = (0..outputs).flat_map(|o| (0..blocks).map(move |i| (o, i)));
        [weight, bias.map(|(o, i)| gradient.bias[i * width + o]).collect()]
    }

    /// Registers of O'.
    #[inline(always)]
    fn registers<S: Simd>(&self) -> usize {
        self.width / Vector::<S, T>::COUNT
    }

    /// A block's weights, `[K, O']`, in tiles of W registers.
    #[inline(always)]
    fn tiles<S: Simd, const W: usize>(&self, simd: S, block: usize) -> &[[T::Register<S>; W]] {
        let size = self.inputs * self.registers::<S>();
        let [weight] = registers(simd, [&self.weight[block * self.inputs * self.width..]], size);
        weight.as_chunks().0
    }
}

impl<T: Element> SparseGradient<T> {
    /// Adds another.
    pub fn add(&mut self, other: &Self) {
        vector::add(&mut self.weight, &other.weight);
        vector::add(&mut self.bias, &other.bias);
    }
}

/// What is done for each row with the blocks it wants: with P of them at a time, and W of their registers.
trait Pass<S: Simd> {
    /// Before any.
    #[inline(always)]
    fn begin(&mut self, _simd: S, _r: usize) {}

    fn blocks<const P: usize, const W: usize>(&mut self, simd: S, r: usize, blocks: [usize; P], tile: usize);
}

/// Row by row. There are as many registers at once as keep the processor busy: no sum waits for the one before.
#[inline(always)]
fn rows<S: Simd>(simd: S, pass: &mut impl Pass<S>, part: &Part<'_>, registers: usize) {
    // Loops, for the closure of a `for_each` is not always made part of the kernel.
    for r in 0..part.rows {
        let wanted = part.wanted.row(part.blocks.start, r);
        pass.begin(simd, r);
        if S::REGISTER_COUNT > 16 && registers.is_multiple_of(4) {
            for tile in 0..registers / 4 {
                tiles::<S, 4>(simd, pass, r, wanted, tile);
            }
        } else if registers.is_multiple_of(2) {
            for tile in 0..registers / 2 {
                tiles::<S, 2>(simd, pass, r, wanted, tile);
            }
        } else {
            for tile in 0..registers {
                tiles::<S, 1>(simd, pass, r, wanted, tile);
            }
        }
    }
}

#[inline(always)]
fn tiles<S: Simd, const W: usize>(simd: S, pass: &mut impl Pass<S>, r: usize, wanted: &[u32], tile: usize) {
    let (fours, rest) = wanted.as_chunks::<4>();
    let (twos, rest) = rest.as_chunks::<2>();
    for blocks in fours {
        pass.blocks::<4, W>(simd, r, blocks.map(|block| block as usize), tile);
    }
    for blocks in twos {
        pass.blocks::<2, W>(simd, r, blocks.map(|block| block as usize), tile);
    }
    for block in rest {
        pass.blocks::<1, W>(simd, r, [*block as usize], tile);
    }
}

/// Takes what a layer gives while it is still in registers.
pub trait Taker<T: Element> {
    /// Tiles of W registers of P blocks of row r.
    fn take<S: Simd, const P: usize, const W: usize>(
        &mut self,
        simd: S,
        r: usize,
        blocks: [usize; P],
        tile: usize,
        values: [[Vector<S, T>; W]; P],
    );
}

#[derive(Debug)]
struct Forward<'a, T, F> {
    layer: &'a Sparse<T>,
    part: &'a Part<'a>,
    open: &'a Open,
    /// `[blocks, O']`.
    bias: &'a [T],
    x: &'a [T],
    taker: &'a mut F,
}

impl<T: Element, F: Taker<T>> WithSimd for Forward<'_, T, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (part, registers) = (self.part, self.layer.registers::<S>());
        rows(simd, &mut self, part, registers);
    }
}

impl<S: Simd, T: Element, F: Taker<T>> Pass<S> for Forward<'_, T, F> {
    #[inline(always)]
    fn blocks<const P: usize, const W: usize>(&mut self, simd: S, r: usize, blocks: [usize; P], tile: usize) {
        let Self { layer, open, bias, x, taker, .. } = self;
        let (inputs, registers_of_block) = (layer.inputs, layer.registers::<S>());
        let tiles = registers_of_block / W;
        let x = &x[r * inputs..][..inputs];
        let (mut weights, mut sums) = ([[].as_slice(); P], [[Vector::splat(simd, T::ZERO); W]; P]);
        for ((weight, sums), block) in weights.iter_mut().zip(&mut sums).zip(blocks) {
            *weight = layer.tiles::<S, W>(simd, block);
            let [bias] = registers(simd, [&bias[block * layer.width..]], registers_of_block);
            for (sum, bias) in sums.iter_mut().zip(&bias[tile * W..][..W]) {
                [*sum] = Vector::from_registers(simd, [*bias]);
            }
        }
        for k in open.row(0, r) {
            let k = *k as usize;
            let x = Vector::splat(simd, x[k]);
            for (sums, weight) in sums.iter_mut().zip(weights) {
                for (sum, a) in sums.iter_mut().zip(&weight[k * tiles + tile]) {
                    *sum = x.mul_add(Vector::from_registers(simd, [*a])[0], *sum);
                }
            }
        }
        taker.take(simd, r, blocks, tile, sums);
    }
}

#[derive(Debug)]
struct Backward<'a, T> {
    layer: &'a Sparse<T>,
    part: &'a Part<'a>,
    open: &'a Open,
    y_bar: &'a [T],
    sums: &'a mut [T],
}

impl<T: Element> WithSimd for Backward<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (part, registers) = (self.part, self.layer.registers::<S>());
        rows(simd, &mut self, part, registers);
    }
}

impl<S: Simd, T: Element> Pass<S> for Backward<'_, T> {
    #[inline(always)]
    fn begin(&mut self, simd: S, r: usize) {
        let Self { layer, part, open, sums, .. } = self;
        if part.blocks.start == 0 {
            let [sums] = registers_mut(simd, [sums], part.rows * layer.inputs);
            for k in open.row(0, r) {
                sums[r * layer.inputs + *k as usize] = Vector::splat(simd, T::ZERO).register();
            }
        }
    }

    #[inline(always)]
    fn blocks<const P: usize, const W: usize>(&mut self, simd: S, r: usize, blocks: [usize; P], tile: usize) {
        let Self { layer, part, open, y_bar, sums } = self;
        let registers_of_block = layer.registers::<S>();
        let tiles = registers_of_block / W;
        let mut weights = [[].as_slice(); P];
        let mut ys = [[Vector::splat(simd, T::ZERO); W]; P];
        for ((weight, ys), block) in weights.iter_mut().zip(&mut ys).zip(blocks) {
            *weight = layer.tiles::<S, W>(simd, block);
            let [y] = registers(simd, [&y_bar[part.at(r, block, layer.width)..]], registers_of_block);
            for (to, y) in ys.iter_mut().zip(&y[tile * W..][..W]) {
                [*to] = Vector::from_registers(simd, [*y]);
            }
        }
        let [sums] = registers_mut(simd, [sums], part.rows * layer.inputs);
        let sums = &mut sums[r * layer.inputs..][..layer.inputs];
        for k in open.row(0, r) {
            let k = *k as usize;
            let [sum] = Vector::from_registers(simd, [sums[k]]);
            // Two, since each waits for the one before.
            let mut halves = [sum, Vector::splat(simd, T::ZERO)];
            for (p, (ys, weight)) in ys.iter().zip(weights).enumerate() {
                for (w, (y, a)) in ys.iter().zip(&weight[k * tiles + tile]).enumerate() {
                    let half = (p * W + w) % 2;
                    halves[half] = y.mul_add(Vector::from_registers(simd, [*a])[0], halves[half]);
                }
            }
            sums[k] = (halves[0] + halves[1]).register();
        }
    }
}

#[derive(Debug)]
struct AddUp<'a, T> {
    inputs: usize,
    open: &'a Open,
    sums: &'a [T],
    x_bar: &'a mut [T],
}

impl<T: Element> WithSimd for AddUp<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { inputs, open, sums, x_bar } = self;
        let [sums] = registers(simd, [sums], x_bar.len());
        x_bar.fill(T::ZERO);
        for (r, (x_bar, sums)) in x_bar.chunks_exact_mut(inputs).zip(sums.chunks_exact(inputs)).enumerate() {
            for k in open.row(0, r) {
                let k = *k as usize;
                x_bar[k] = Vector::from_registers(simd, [sums[k]])[0].sum();
            }
        }
    }
}

/// Of the first order, or of both.
#[derive(Debug)]
struct Accumulate<'a, T, const SECOND: bool> {
    layer: &'a Sparse<T>,
    part: &'a Part<'a>,
    open: &'a Open,
    /// x and ŷ.
    first: (&'a [T], &'a [T]),
    /// ẋ and ȳ; in the first order whatever there is.
    second: (&'a [T], &'a [T]),
    gradient: &'a mut SparseGradient<T>,
}

impl<T: Element, const SECOND: bool> WithSimd for Accumulate<'_, T, SECOND> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (part, registers) = (self.part, self.layer.registers::<S>());
        rows(simd, &mut self, part, registers);
    }
}

impl<S: Simd, T: Element, const SECOND: bool> Pass<S> for Accumulate<'_, T, SECOND> {
    #[inline(always)]
    fn blocks<const P: usize, const W: usize>(&mut self, simd: S, r: usize, blocks: [usize; P], tile: usize) {
        let Self { layer, part, open, first, second, gradient } = self;
        let (inputs, width, count) = (layer.inputs, layer.width, layer.registers::<S>());
        let at = tile * W;
        let [x, x_dot] = [first.0, second.0].map(|x| &x[r * inputs..][..inputs]);
        for block in blocks {
            let lines = [first.1, second.1].map(|y| &y[part.at(r, block, width)..]);
            let [y_hat, y_bar] = registers(simd, lines, count).map(|y| &y[at..][..W]);
            let (mut ys, mut y_bars) = ([Vector::splat(simd, T::ZERO); W], [Vector::splat(simd, T::ZERO); W]);
            let [bias] = registers_mut(simd, [&mut gradient.bias[block * width..]], count);
            for w in 0..W {
                [ys[w], y_bars[w]] = Vector::from_registers(simd, [y_hat[w], y_bar[w]]);
                bias[at + w] = (Vector::from_registers(simd, [bias[at + w]])[0] + ys[w]).register();
            }
            let [weight] = registers_mut(simd, [&mut gradient.weight[block * inputs * width..]], inputs * count);
            for k in open.row(0, r) {
                let k = *k as usize;
                let (x, x_dot) = (Vector::splat(simd, x[k]), Vector::splat(simd, x_dot[k]));
                let line = &mut weight[k * count + at..][..W];
                for w in 0..W {
                    let mut sum = x.mul_add(ys[w], Vector::from_registers(simd, [line[w]])[0]);
                    if SECOND {
                        sum = x_dot.mul_add(y_bars[w], sum);
                    }
                    line[w] = sum.register();
                }
            }
        }
    }
}
