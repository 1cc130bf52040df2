//! Block-sparse linear layer: for each row only the active inputs are read, and only the active blocks of outputs computed.
//!
//! The inputs are activations after a rectified linear unit, about half of them zero. The outputs are divided into blocks of O; a
//! block is inactive where the gated input is zero.

use crate::engine::layers::passes::{Cotangent, Primal};
use crate::engine::layers::relu::ActiveSet;
use crate::engine::simd::buffer::{AlignedVec, resize, zeros};
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::{Vector, VectorShape, add, registers, registers_mut};
use pulp::{Arch, Simd, WithSimd};
use std::ops::Range;

/// The layer's weights. O' is O rounded up to whole registers, padded with zeros.
#[derive(Debug)]
pub struct BlockSparseLinear<T> {
    /// K, the number of inputs.
    pub inputs: usize,
    /// O'.
    pub width: usize,
    /// O, the number of outputs in a block.
    outputs: usize,
    /// `[blocks, K, O']`.
    weight: AlignedVec<T>,
    /// `[blocks, O']`.
    bias: AlignedVec<T>,
    /// Zeros, `[blocks, O']`, the bias in a jvp.
    zeros: AlignedVec<T>,
}

/// Gradient of a loss in the weights, in the layout of the layer.
#[derive(Debug)]
pub struct BlockSparseGradient<T> {
    pub weight: AlignedVec<T>,
    pub bias: AlignedVec<T>,
}

/// A range of blocks, for R = `rows` rows.
#[derive(Debug, Clone)]
pub struct BlockRange<'a> {
    pub rows: usize,
    pub blocks: Range<usize>,
    /// Active blocks of each row.
    pub active: &'a ActiveSet,
}

impl<'a> BlockRange<'a> {
    /// Active blocks of row r.
    #[inline(always)]
    pub fn active_blocks(&self, r: usize) -> impl Iterator<Item = usize> + use<'a> {
        self.active.row(self.blocks.start, r).iter().map(|block| *block as usize)
    }

    /// Offset of a block of row r in an array `[R, blocks of the range, O']`.
    #[inline(always)]
    pub fn offset(&self, r: usize, block: usize, width: usize) -> usize {
        (r * self.blocks.len() + block - self.blocks.start) * width
    }
}

/// O', O rounded up to whole registers.
fn padded<T: Element>(outputs: usize) -> usize {
    outputs.next_multiple_of(VectorShape::of::<T>().lanes)
}

impl<T: Element> BlockSparseLinear<T> {
    /// A layer of weight `[O, blocks, K]` and bias `[O, blocks]`.
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

    /// Number of blocks.
    pub fn blocks(&self) -> usize {
        self.bias.len() / self.width
    }

    /// A zero gradient.
    pub fn gradient(&self) -> BlockSparseGradient<T> {
        BlockSparseGradient { weight: zeros(self.weight.len()), bias: zeros(self.bias.len()) }
    }

    /// y = a x + b of a range, from the `active` inputs of x `[R, K]`; `epilogue` consumes y in registers.
    pub fn forward(&self, range: &BlockRange<'_>, active: &ActiveSet, x: &[T], epilogue: &mut impl Epilogue<T>) {
        Arch::new().dispatch(Forward { layer: self, range, active, bias: &self.bias, x, epilogue });
    }

    /// The tangent ẏ = a ẋ of a range; `epilogue` consumes it in registers.
    pub fn jvp(&self, range: &BlockRange<'_>, active: &ActiveSet, x_dot: &[T], epilogue: &mut impl Epilogue<T>) {
        Arch::new().dispatch(Forward { layer: self, range, active, bias: &self.zeros, x: x_dot, epilogue });
    }

    /// The gradient x̄ `[R, K]` of ȳ, which is passed range by range, `[R, blocks of the range, O']`. The first range resets the
    /// partial `sums`, a register for each active x̄; the last range adds up their lanes and writes x̄.
    pub fn vjp(
        &self,
        range: &BlockRange<'_>,
        active: &ActiveSet,
        y_bar: &[T],
        sums: &mut AlignedVec<T>,
        x_bar: &mut [T],
    ) {
        let sums = resize(sums, range.rows * self.inputs * VectorShape::of::<T>().lanes);
        Arch::new().dispatch(Vjp { layer: self, range, active, y_bar, sums });
        if range.blocks.end == self.blocks() {
            Arch::new().dispatch(Accumulate { inputs: self.inputs, active, sums, x_bar });
        }
    }

    /// Adds the gradient in the weights of a range, of ŷ and, in the second order, ȳ, from x and ẋ.
    pub fn accumulate(
        &self,
        range: &BlockRange<'_>,
        active: &ActiveSet,
        primal: Primal<'_, T>,
        cotangent: Cotangent<'_, T>,
        gradient: &mut BlockSparseGradient<T>,
    ) {
        let layer = self;
        if cotangent.is_second_order() {
            Arch::new().dispatch(WeightGradient::<T, true> { layer, range, active, primal, cotangent, gradient });
        } else {
            // Placeholders: the terms of the second order are sliced, but not read.
            let primal = Primal { x_dot: primal.x, ..primal };
            let cotangent = Cotangent { y_bar: cotangent.y_hat, ..cotangent };
            Arch::new().dispatch(WeightGradient::<T, false> { layer, range, active, primal, cotangent, gradient });
        }
    }

    /// A gradient in the layout of the checkpoint: `[O, blocks, K]` and `[O, blocks]`.
    pub fn in_weights(&self, gradient: &BlockSparseGradient<T>) -> [Vec<T>; 2] {
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

    /// Number of registers of O'.
    #[inline(always)]
    fn registers<S: Simd>(&self) -> usize {
        self.width / Vector::<S, T>::COUNT
    }

    /// Weights of a block, `[K, O']`, in tiles of W registers.
    #[inline(always)]
    fn tiles<S: Simd, const W: usize>(&self, simd: S, block: usize) -> &[[T::Register<S>; W]] {
        let size = self.inputs * self.registers::<S>();
        let [weight] = registers(simd, [&self.weight[block * self.inputs * self.width..]], size);
        weight.as_chunks().0
    }
}

impl<T: Element> BlockSparseGradient<T> {
    /// `self += other`.
    pub fn add(&mut self, other: &Self) {
        add(&mut self.weight, &other.weight);
        add(&mut self.bias, &other.bias);
    }
}

/// A pass over the active blocks of each row, P blocks and W of their registers at a time.
trait Pass<S: Simd> {
    /// Preparation of a row, before its blocks.
    #[inline(always)]
    fn begin(&mut self, _simd: S, _r: usize) {}

    /// P blocks of row r, at a tile of W registers.
    fn blocks<const P: usize, const W: usize>(&mut self, simd: S, r: usize, blocks: [usize; P], tile: usize);
}

/// Runs a pass over all rows of a range, with several registers at a time, whose sums are independent in the processor's pipeline.
#[inline(always)]
fn for_each_row<S: Simd>(simd: S, pass: &mut impl Pass<S>, range: &BlockRange<'_>, registers: usize) {
    // Loops, since the closure of a `for_each` is not always inlined into the kernel.
    for r in 0..range.rows {
        let active = range.active.row(range.blocks.start, r);
        pass.begin(simd, r);
        if S::REGISTER_COUNT > 16 && registers.is_multiple_of(4) {
            for tile in 0..registers / 4 {
                for_each_block::<S, 4>(simd, pass, r, active, tile);
            }
        } else if registers.is_multiple_of(2) {
            for tile in 0..registers / 2 {
                for_each_block::<S, 2>(simd, pass, r, active, tile);
            }
        } else {
            for tile in 0..registers {
                for_each_block::<S, 1>(simd, pass, r, active, tile);
            }
        }
    }
}

/// Runs a pass over all active blocks of a row, at a tile of W registers.
#[inline(always)]
fn for_each_block<S: Simd, const W: usize>(simd: S, pass: &mut impl Pass<S>, r: usize, active: &[u32], tile: usize) {
    let (fours, rest) = active.as_chunks::<4>();
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

/// An epilogue: consumes a layer's outputs while they are in registers.
pub trait Epilogue<T: Element> {
    /// Consumes tiles of W registers of P blocks of row r.
    fn apply<S: Simd, const P: usize, const W: usize>(
        &mut self,
        simd: S,
        r: usize,
        blocks: [usize; P],
        tile: usize,
        values: [[Vector<S, T>; W]; P],
    );
}

/// [`BlockSparseLinear::forward`] and [`BlockSparseLinear::jvp`].
#[derive(Debug)]
struct Forward<'a, T, F> {
    layer: &'a BlockSparseLinear<T>,
    range: &'a BlockRange<'a>,
    active: &'a ActiveSet,
    /// `[blocks, O']`.
    bias: &'a [T],
    x: &'a [T],
    epilogue: &'a mut F,
}

impl<T: Element, F: Epilogue<T>> WithSimd for Forward<'_, T, F> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (range, registers) = (self.range, self.layer.registers::<S>());
        for_each_row(simd, &mut self, range, registers);
    }
}

impl<S: Simd, T: Element, F: Epilogue<T>> Pass<S> for Forward<'_, T, F> {
    #[inline(always)]
    fn blocks<const P: usize, const W: usize>(&mut self, simd: S, r: usize, blocks: [usize; P], tile: usize) {
        let Self { layer, active, bias, x, epilogue, .. } = self;
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

        for k in active.row(0, r) {
            let k = *k as usize;
            let x = Vector::splat(simd, x[k]);
            for (sums, weight) in sums.iter_mut().zip(weights) {
                for (sum, a) in sums.iter_mut().zip(&weight[k * tiles + tile]) {
                    *sum = x.mul_add(Vector::from_registers(simd, [*a])[0], *sum);
                }
            }
        }
        epilogue.apply(simd, r, blocks, tile, sums);
    }
}

/// [`BlockSparseLinear::vjp`] of a range, into the partial sums.
#[derive(Debug)]
struct Vjp<'a, T> {
    layer: &'a BlockSparseLinear<T>,
    range: &'a BlockRange<'a>,
    active: &'a ActiveSet,
    y_bar: &'a [T],
    sums: &'a mut [T],
}

impl<T: Element> WithSimd for Vjp<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (range, registers) = (self.range, self.layer.registers::<S>());
        for_each_row(simd, &mut self, range, registers);
    }
}

impl<S: Simd, T: Element> Pass<S> for Vjp<'_, T> {
    #[inline(always)]
    fn begin(&mut self, simd: S, r: usize) {
        let Self { layer, range, active, sums, .. } = self;
        if range.blocks.start == 0 {
            let [sums] = registers_mut(simd, [sums], range.rows * layer.inputs);
            for k in active.row(0, r) {
                sums[r * layer.inputs + *k as usize] = Vector::splat(simd, T::ZERO).register();
            }
        }
    }

    #[inline(always)]
    fn blocks<const P: usize, const W: usize>(&mut self, simd: S, r: usize, blocks: [usize; P], tile: usize) {
        let Self { layer, range, active, y_bar, sums } = self;
        let registers_of_block = layer.registers::<S>();
        let tiles = registers_of_block / W;
        let mut weights = [[].as_slice(); P];
        let mut ys = [[Vector::splat(simd, T::ZERO); W]; P];
        for ((weight, ys), block) in weights.iter_mut().zip(&mut ys).zip(blocks) {
            *weight = layer.tiles::<S, W>(simd, block);
            let [y] = registers(simd, [&y_bar[range.offset(r, block, layer.width)..]], registers_of_block);
            for (y_register, y) in ys.iter_mut().zip(&y[tile * W..][..W]) {
                [*y_register] = Vector::from_registers(simd, [*y]);
            }
        }

        let [sums] = registers_mut(simd, [sums], range.rows * layer.inputs);
        let sums = &mut sums[r * layer.inputs..][..layer.inputs];
        for k in active.row(0, r) {
            let k = *k as usize;
            let [sum] = Vector::from_registers(simd, [sums[k]]);
            // Two independent sums, to hide the latency of additions.
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

/// Horizontal sums of the partial sums: x̄, zero for inactive inputs.
#[derive(Debug)]
struct Accumulate<'a, T> {
    inputs: usize,
    active: &'a ActiveSet,
    sums: &'a [T],
    x_bar: &'a mut [T],
}

impl<T: Element> WithSimd for Accumulate<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { inputs, active, sums, x_bar } = self;
        let [sums] = registers(simd, [sums], x_bar.len());
        x_bar.fill(T::ZERO);
        for (r, (x_bar, sums)) in x_bar.chunks_exact_mut(inputs).zip(sums.chunks_exact(inputs)).enumerate() {
            for k in active.row(0, r) {
                let k = *k as usize;
                x_bar[k] = Vector::from_registers(simd, [sums[k]])[0].sum();
            }
        }
    }
}

/// [`BlockSparseLinear::accumulate`], of the first order or of both.
#[derive(Debug)]
struct WeightGradient<'a, T, const SECOND: bool> {
    layer: &'a BlockSparseLinear<T>,
    range: &'a BlockRange<'a>,
    active: &'a ActiveSet,
    primal: Primal<'a, T>,
    cotangent: Cotangent<'a, T>,
    gradient: &'a mut BlockSparseGradient<T>,
}

impl<T: Element, const SECOND: bool> WithSimd for WeightGradient<'_, T, SECOND> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (range, registers) = (self.range, self.layer.registers::<S>());
        for_each_row(simd, &mut self, range, registers);
    }
}

impl<S: Simd, T: Element, const SECOND: bool> Pass<S> for WeightGradient<'_, T, SECOND> {
    #[inline(always)]
    fn blocks<const P: usize, const W: usize>(&mut self, simd: S, r: usize, blocks: [usize; P], tile: usize) {
        let Self { layer, range, active, primal, cotangent, gradient } = self;
        let (inputs, width, count) = (layer.inputs, layer.width, layer.registers::<S>());
        let at = tile * W;
        let [x, x_dot] = [primal.x, primal.x_dot].map(|x| &x[r * inputs..][..inputs]);
        for block in blocks {
            let lines = [cotangent.y_hat, cotangent.y_bar].map(|y| &y[range.offset(r, block, width)..]);
            let [y_hat, y_bar] = registers(simd, lines, count).map(|y| &y[at..][..W]);
            let (mut ys, mut y_bars) = ([Vector::splat(simd, T::ZERO); W], [Vector::splat(simd, T::ZERO); W]);
            let [bias] = registers_mut(simd, [&mut gradient.bias[block * width..]], count);
            for w in 0..W {
                [ys[w], y_bars[w]] = Vector::from_registers(simd, [y_hat[w], y_bar[w]]);
                bias[at + w] = (Vector::from_registers(simd, [bias[at + w]])[0] + ys[w]).register();
            }

            let [weight] = registers_mut(simd, [&mut gradient.weight[block * inputs * width..]], inputs * count);
            for k in active.row(0, r) {
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
