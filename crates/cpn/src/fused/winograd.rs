//! Convolutions by fewer products: minimal filtering after Winograd (Lavin and Gray, arXiv 1509.09308).
//!
//! A kernel as wide as r = 2 or 3 strides has r taps in either direction, each of which weighs a block of stride x stride pixels.
//! Four blocks in a row, d, give m = 5 - r sums of taps, y, by four products, where g(t) = Σ gᵢ tⁱ and g(∞) is the last tap:
//!
//! - p₀ = (d₀ - d₂) g(0), p₁ = (d₁ + d₂) g(1)/2, p₂ = (d₂ - d₁) g(-1)/2, p₃ = (d₁ - d₃) g(∞)
//! - y₀ = p₀ + p₁ + p₂, then if m = 3 p₁ - p₂, and last p₁ ± p₂ - p₃, with + if m = 3
//!
//! In both directions, a tile of 4 x 4 blocks gives m x m outputs by 16 products for each pair of channels, where patches take
//! 36. These points need only sums and halves, which cost float32 next to nothing.

use super::lanes::{Aligned, Lanes, grown, registers, registers_mut, zeros};
use super::matrix::Panels;
use super::product::{Left, multiply};
use super::real::Real;
use pulp::{Arch, Simd, WithSimd};
use std::array;

/// 0, 1, -1 and ∞: as many as a tile has blocks in a row.
const POINTS: usize = 4;
/// Tiles that are multiplied at once, if there are so many: with more of them weights are read less often, with fewer the
/// products lie nearer.
const TILES: usize = 64;
/// The product at 1 in both directions, which every output has once.
const ONES: usize = POINTS + 1;
/// Numbers behind others, for registers that reach beyond their end: as many as the widest hold.
pub const BEYOND: usize = 16;

/// A convolution over images whose channels lie together, `[S, S, C]`, and a rectified linear unit.
#[derive(Debug)]
pub struct Winograd<T> {
    /// S.
    side: usize,
    /// S C, the numbers of a line of the image.
    line: usize,
    stride: usize,
    /// stride C, a block's numbers in a line.
    run: usize,
    /// S'.
    size: usize,
    /// m.
    kept: usize,
    /// The blocks and outputs where tiles begin, in either direction; the last early enough to end within the image.
    starts: Vec<usize>,
    /// g at each pair of points, `[D, O]`, where D = stride² C.
    weights: Vec<Panels<T>>,
    /// `[O]`.
    bias: Vec<T>,
}

/// Room for what lies between an image and its outputs, kept from image to image.
#[derive(Debug)]
pub struct Room<T> {
    /// d of a row of tiles, combined over its blocks' rows.
    lines: Aligned<T>,
    /// d, combined in both directions: for each pair of points `[tiles, D]`.
    d: Aligned<T>,
    /// For each pair of points `[tiles, O]`.
    p: Aligned<T>,
    /// p of a tile, combined over its rows, `[m, POINTS, O]`.
    half: Aligned<T>,
}

impl<T: Real> Room<T> {
    /// Empty.
    pub fn new() -> Self {
        Self { lines: zeros(0), d: zeros(0), p: zeros(0), half: zeros(0) }
    }
}

impl<T: Real> Winograd<T> {
    /// Of S = `side` and C = `channels`, with `weight`, `[O, C, K, K]`, and `bias`, `[O]`; None where this does not apply.
    pub fn new(
        (side, channels): (usize, usize),
        (kernel, stride): (usize, usize),
        weight: &[T],
        bias: &[T],
    ) -> Option<Self> {
        let (taps, size, outputs) = (kernel / stride, (side - kernel) / stride + 1, bias.len());
        let kept = (POINTS + 1).saturating_sub(taps);
        if kernel != taps * stride || !(2..=3).contains(&taps) || size < kept || !outputs.is_multiple_of(BEYOND) {
            return None;
        }
        let (run, depth) = (stride * channels, stride * stride * channels);
        let at_points = |pair: usize| {
            let weight = |at: usize| {
                let (o, (y, x, c)) = (at / depth, (at % depth / run, at / channels % stride, at % channels));
                let tap = |i, j| weight[((o * channels + c) * kernel + i * stride + y) * kernel + j * stride + x];
                at_point(pair / POINTS, taps, |i| at_point(pair % POINTS, taps, |j| tap(i, j)))
            };
            Panels::transposed(&Vec::from_iter((0..outputs * depth).map(weight)), depth)
        };
        Some(Self {
            side,
            line: side * channels,
            stride,
            run,
            size,
            kept,
            starts: (0..size).step_by(kept).map(|start| start.min(size - kept)).collect(),
            weights: (0..POINTS * POINTS).map(at_points).collect(),
            bias: bias.to_vec(),
        })
    }

    /// Images `[R, S, S, C]`, with [`BEYOND`] numbers behind them, to `[R, S', S', O]`.
    pub fn forward(&self, x: &[T], y: &mut [T], room: &mut Room<T>) {
        let images = TILES.div_ceil(self.starts.len().pow(2));
        let (from, to) = (self.side * self.line, self.size * self.size * self.bias.len());
        for (i, y) in y.chunks_mut(images * to).enumerate() {
            self.at_once(&x[i * images * from..], y, room);
        }
    }

    fn at_once(&self, x: &[T], y: &mut [T], room: &mut Room<T>) {
        let Self { line, stride, run, size, kept, starts, bias, .. } = self;
        let (depth, outputs) = (stride * run, bias.len());
        let tiles = y.len() / (size * size * outputs) * starts.len().pow(2);
        let lines = grown(&mut room.lines, POINTS * (stride * line + BEYOND));
        let d = grown(&mut room.d, POINTS * POINTS * (tiles * depth + BEYOND));
        let p = grown(&mut room.p, POINTS * POINTS * tiles * outputs);
        let half = grown(&mut room.half, kept * POINTS * outputs);
        Arch::new().dispatch(Enter { layer: self, tiles, x, lines, d });
        p.chunks_exact_mut(outputs).skip(ONES * tiles).take(tiles).for_each(|p| p.copy_from_slice(bias));
        let points = d.chunks_exact(tiles * depth + BEYOND).zip(p.chunks_exact_mut(tiles * outputs));
        for (pair, (weights, (d, p))) in self.weights.iter().zip(points).enumerate() {
            multiply(pair == ONES, p, Left::Rows(&d[..tiles * depth]), weights.matrix(0..outputs));
        }
        match kept {
            2 => Arch::new().dispatch(Leave::<T, 2> { layer: self, p, half, y }),
            _ => Arch::new().dispatch(Leave::<T, 3> { layer: self, p, half, y }),
        }
    }
}

/// g of so many taps at a point, halved at 1 and -1.
fn at_point<T: Real>(point: usize, taps: usize, tap: impl Fn(usize) -> T) -> T {
    let sum = |parity: usize| (parity..taps).step_by(2).map(&tap).sum::<T>();
    let half = T::ONE / T::count(2);
    match point {
        0 => tap(0),
        1 => (sum(0) + sum(1)) * half,
        2 => (sum(0) - sum(1)) * half,
        _ => tap(taps - 1),
    }
}

/// From images to d, combined in both directions.
///
/// What a register writes beyond the end of a line, or of a block's part of it, is overwritten by what comes next.
#[derive(Debug)]
struct Enter<'a, T> {
    layer: &'a Winograd<T>,
    tiles: usize,
    x: &'a [T],
    lines: &'a mut [T],
    d: &'a mut [T],
}

impl<T: Real> WithSimd for Enter<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { layer: &Winograd { side, line, stride, run, ref starts, .. }, tiles, x, lines, d } = self;
        let mut lines = parts::<T, POINTS>(lines);
        let mut d = parts::<T, { POINTS * POINTS }>(d);
        for (row, first) in (0..tiles).step_by(starts.len()).enumerate() {
            let (image, top) = (row / starts.len() * side * line, starts[row % starts.len()]);
            for y in 0..stride {
                let row = |i| &x[image + ((top + i) * stride + y) * line..];
                let into = lines.each_mut().map(|lines| &mut lines[y * line..]);
                combine(simd, line, [row(0), row(1), row(2), row(3)], into);
            }
            for (lines, d) in lines.iter().zip(d.as_chunks_mut::<POINTS>().0) {
                for (t, left) in starts.iter().enumerate() {
                    for y in 0..stride {
                        let block = |j| &lines[y * line + (left + j) * run..];
                        let into = d.each_mut().map(|d| &mut d[((first + t) * stride + y) * run..]);
                        combine(simd, run, [block(0), block(1), block(2), block(3)], into);
                    }
                }
            }
        }
    }
}

/// From p to outputs.
#[derive(Debug)]
struct Leave<'a, T, const KEPT: usize> {
    layer: &'a Winograd<T>,
    p: &'a [T],
    half: &'a mut [T],
    y: &'a mut [T],
}

impl<T: Real, const KEPT: usize> WithSimd for Leave<'_, T, KEPT> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { layer: &Winograd { size, ref starts, ref bias, .. }, p, half, y } = self;
        let (outputs, apart) = (bias.len(), p.len() / (POINTS * POINTS));
        let mut tile = 0;
        for image in y.chunks_exact_mut(size * size * outputs) {
            for (top, left) in starts.iter().flat_map(|top| starts.iter().map(move |left| (top, left))) {
                for j in 0..POINTS {
                    let row = |i| &p[(i * POINTS + j) * apart + tile * outputs..];
                    let into = parts::<T, KEPT>(half).map(|half| &mut half[j * outputs..]);
                    keep(simd, outputs, [row(0), row(1), row(2), row(3)], into, |y| y);
                }
                for (i, half) in half.chunks_exact(POINTS * outputs).enumerate() {
                    let column = |j| &half[j * outputs..];
                    let into = &mut image[((top + i) * size + left) * outputs..][..KEPT * outputs];
                    let columns = [column(0), column(1), column(2), column(3)];
                    keep(simd, outputs, columns, parts::<T, KEPT>(into), Lanes::rectified);
                }
                tile += 1;
            }
        }
    }
}

/// Of d in a row, each `length` numbers, what the products are made of.
#[inline(always)]
fn combine<S: Simd, T: Real>(simd: S, length: usize, d: [&[T]; POINTS], into: [&mut [T]; POINTS]) {
    let count = length.div_ceil(Lanes::<S, T>::COUNT);
    let d = registers(simd, d, count);
    let into = registers_mut(simd, into, count);
    for i in 0..count {
        let [d0, d1, d2, d3] = Lanes::<S, T>::each(simd, [d[0][i], d[1][i], d[2][i], d[3][i]]);
        into[0][i] = (d0 - d2).values();
        into[1][i] = (d1 + d2).values();
        into[2][i] = (d2 - d1).values();
        into[3][i] = (d1 - d3).values();
    }
}

/// Of p in a row, each `length` numbers, what it adds up to.
#[inline(always)]
fn keep<S: Simd, T: Real, const KEPT: usize>(
    simd: S,
    length: usize,
    p: [&[T]; POINTS],
    into: [&mut [T]; KEPT],
    finish: impl Fn(Lanes<S, T>) -> Lanes<S, T>,
) {
    let count = length.div_ceil(Lanes::<S, T>::COUNT);
    let p = registers(simd, p, count);
    let into = registers_mut(simd, into, count);
    for i in 0..count {
        let [p0, p1, p2, p3] = Lanes::<S, T>::each(simd, [p[0][i], p[1][i], p[2][i], p[3][i]]);
        let (sum, difference) = (p1 + p2, p1 - p2);
        into[0][i] = finish(p0 + sum).values();
        into[1][i] = finish(if KEPT == 2 { difference - p3 } else { difference }).values();
        if KEPT == 3 {
            into[2][i] = finish(sum - p3).values();
        }
    }
}

/// N equal parts.
fn parts<T, const N: usize>(slice: &mut [T]) -> [&mut [T]; N] {
    let mut parts = slice.chunks_exact_mut(slice.len() / N);
    array::from_fn(|_| parts.next().unwrap_or_default())
}
