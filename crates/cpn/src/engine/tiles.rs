//! What [minimal filtering](super::winograd) adds up before and after its products.
//!
//! Four blocks in a row, d, give m sums of r = 5 - m taps, y, by four products, where g(t) = Σ gᵢ tⁱ and g(∞) is the last tap:
//!
//! - p₀ = (d₀ - d₂) g(0), p₁ = (d₁ + d₂) g(1)/2, p₂ = (d₂ - d₁) g(-1)/2, p₃ = (d₁ - d₃) g(∞)
//! - y₀ = p₀ + p₁ + p₂, then if m = 3 p₁ - p₂, and last p₁ ± p₂ - p₃, with + if m = 3
//!
//! A tile does so in both directions. These points need only sums and halves, which cost float32 next to nothing. Each step has
//! an adjoint, which leads a loss' gradient in what the step gives back to one in what it takes. But for the last step, all go
//! through the points of one direction one after the other, so that what they leave for the products lies near.

use crate::engine::simd::element::Element;
use crate::engine::simd::vector::{Vector, registers, registers_mut};
use pulp::{Arch, Simd, WithSimd};
use std::array;

/// 0, 1, -1 and ∞: as many as a tile has blocks in a row.
pub const POINTS: usize = 4;
/// What p at each point is made of: the first d, and the second times a sign.
const COMBINED: [(usize, usize, i8); POINTS] = [(0, 2, -1), (1, 2, 1), (2, 1, -1), (1, 3, -1)];
/// Of points, one for each direction.
pub const PAIRS: usize = POINTS * POINTS;
/// The pair of 1 in both directions.
pub const ONES: usize = POINTS + 1;
/// Numbers behind others, for registers that reach beyond their end: as many as the widest hold.
pub const BEYOND: usize = 16;

/// How images `[S, S, C]` are cut into tiles, and their outputs `[S', S', O]`.
#[derive(Debug)]
pub struct Tiles {
    /// S.
    side: usize,
    /// C.
    pub channels: usize,
    pub stride: usize,
    /// O, a multiple of [`BEYOND`].
    pub outputs: usize,
    /// S'.
    size: usize,
    /// m.
    kept: usize,
    /// The blocks and outputs where tiles begin, in either direction; the last early enough to end within the image.
    starts: Vec<usize>,
}

impl Tiles {
    /// None if the images are smaller than a tile.
    pub fn new((side, channels): (usize, usize), stride: usize, kept: usize, outputs: usize) -> Option<Self> {
        let size = (side / stride + kept).checked_sub(POINTS)?;
        let starts = (0..size).step_by(kept).map(|start| start.min(size - kept));
        (size >= kept).then(|| Self { side, channels, stride, outputs, size, kept, starts: starts.collect() })
    }

    /// Of an image.
    pub fn in_image(&self) -> usize {
        self.starts.len().pow(2)
    }

    /// Numbers of an image, and of its outputs.
    pub fn sizes(&self) -> [usize; 2] {
        [self.side * self.side * self.channels, self.size * self.size * self.outputs]
    }

    /// Numbers of the memory that the steps work in.
    pub fn room(&self) -> usize {
        (self.band() + BEYOND).max(POINTS * self.kept * self.outputs)
    }

    /// Numbers of a block's part of a line.
    fn run(&self) -> usize {
        self.stride * self.channels
    }

    /// Numbers of a line of the image.
    fn line(&self) -> usize {
        self.side * self.channels
    }

    /// Numbers of the lines that a row of blocks takes.
    fn band(&self) -> usize {
        self.stride * self.line()
    }

    /// From images to d, combined in both directions, down at one point: for each across `[tiles, D]`, with [`BEYOND`] numbers
    /// behind it and behind the images.
    pub fn enter<T: Element>(&self, point: usize, x: &[T], d: &mut [T], room: &mut [T]) {
        Arch::new().dispatch(Enter { tiles: self, point, x, d, room });
    }

    /// Adds to x̂ what d̂ at a point gives.
    pub fn enter_adjoint<T: Element>(&self, point: usize, d: &[T], x: &mut [T], room: &mut [T]) {
        Arch::new().dispatch(EnterAdjoint { tiles: self, point, d, x, room });
    }

    /// From p, for each pair of points `[tiles, O]`, to outputs, rectified.
    pub fn leave<T: Element>(&self, p: &[T], y: &mut [T], room: &mut [T]) {
        match self.kept {
            2 => Arch::new().dispatch(Leave::<T, 2> { tiles: self, p, y, room }),
            _ => Arch::new().dispatch(Leave::<T, 3> { tiles: self, p, y, room }),
        }
    }

    /// Writes p̂, down at one point, from ŷ, which is a gradient in what the unit takes.
    pub fn leave_adjoint<T: Element>(&self, point: usize, y: &[T], p: &mut [T], room: &mut [T]) {
        match self.kept {
            2 => Arch::new().dispatch(LeaveAdjoint::<T, 2> { tiles: self, point, y, p, room }),
            _ => Arch::new().dispatch(LeaveAdjoint::<T, 3> { tiles: self, point, y, p, room }),
        }
    }
}

/// What a register writes beyond the end of a line, or of a block's part of it, is overwritten by what comes next.
#[derive(Debug)]
struct Enter<'a, T> {
    tiles: &'a Tiles,
    point: usize,
    x: &'a [T],
    d: &'a mut [T],
    room: &'a mut [T],
}

impl<T: Element> WithSimd for Enter<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { tiles: tiles @ Tiles { stride, starts, .. }, point, x, d, room } = self;
        let (run, line, band) = (tiles.run(), tiles.line(), tiles.band());
        let count = (d.len() / POINTS - BEYOND) / (stride * run);
        let lines = &mut room[..band + BEYOND];
        let mut d = parts::<T, POINTS>(d);
        for (row, first) in (0..count).step_by(starts.len()).enumerate() {
            let x = &x[row / starts.len() * tiles.sizes()[0] + starts[row % starts.len()] * band..];
            combine_at(simd, point, band, x, lines);
            for (t, left) in starts.iter().enumerate() {
                for y in 0..*stride {
                    let block = |j| &lines[y * line + (left + j) * run..];
                    let into = d.each_mut().map(|d| &mut d[((first + t) * stride + y) * run..]);
                    combine(simd, run, [block(0), block(1), block(2), block(3)], into);
                }
            }
        }
    }
}

#[derive(Debug)]
struct EnterAdjoint<'a, T> {
    tiles: &'a Tiles,
    point: usize,
    d: &'a [T],
    x: &'a mut [T],
    room: &'a mut [T],
}

impl<T: Element> WithSimd for EnterAdjoint<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { tiles: tiles @ Tiles { stride, starts, .. }, point, d, x, room } = self;
        let (run, line, band) = (tiles.run(), tiles.line(), tiles.band());
        let apart = d.len() / POINTS;
        let lines = &mut room[..band];
        let mut first = 0;
        for image in x.chunks_exact_mut(tiles.sizes()[0]) {
            for top in starts {
                lines.fill(T::ZERO);
                for (t, left) in starts.iter().enumerate() {
                    for y in 0..*stride {
                        let block = |j| &d[j * apart + ((first + t) * stride + y) * run..][..run];
                        let into = parts::<T, POINTS>(&mut lines[y * line + left * run..][..POINTS * run]);
                        combine_adjoint(simd, [block(0), block(1), block(2), block(3)], into);
                    }
                }
                combine_at_adjoint(simd, point, lines, &mut image[top * band..][..POINTS * band]);
                first += starts.len();
            }
        }
    }
}

#[derive(Debug)]
struct Leave<'a, T, const KEPT: usize> {
    tiles: &'a Tiles,
    p: &'a [T],
    y: &'a mut [T],
    room: &'a mut [T],
}

impl<T: Element, const KEPT: usize> WithSimd for Leave<'_, T, KEPT> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { tiles: &Tiles { size, outputs, ref starts, .. }, p, y, room } = self;
        let apart = p.len() / PAIRS;
        // [m, POINTS, O]
        let half = &mut room[..KEPT * POINTS * outputs];
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
                    keep(simd, outputs, columns, parts::<T, KEPT>(into), Vector::relu);
                }
                tile += 1;
            }
        }
    }
}

#[derive(Debug)]
struct LeaveAdjoint<'a, T, const KEPT: usize> {
    tiles: &'a Tiles,
    point: usize,
    y: &'a [T],
    p: &'a mut [T],
    room: &'a mut [T],
}

impl<T: Element, const KEPT: usize> WithSimd for LeaveAdjoint<'_, T, KEPT> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { tiles: &Tiles { size, outputs, ref starts, .. }, point, y, p, room } = self;
        let width = KEPT * outputs;
        // [m, O], and zeros.
        let (half, nothing) = room.split_at_mut(width);
        nothing[..width].fill(T::ZERO);
        let mut p = parts::<T, POINTS>(p);
        let mut tile = 0;
        for image in y.chunks_exact(size * size * outputs) {
            for (down, top) in starts.iter().enumerate() {
                for (across, left) in starts.iter().enumerate() {
                    // What a tile has in common with the one before counts there alone.
                    let (above, before) = (down * KEPT - top, across * KEPT - left);
                    let row = |i| if i < above { &*nothing } else { &image[((top + i) * size + left) * outputs..] };
                    keep_at_adjoint(simd, point, width, array::from_fn::<_, KEPT, _>(row), half);
                    let column = |j| if j < before { &*nothing } else { &half[j * outputs..] };
                    let into = p.each_mut().map(|p| &mut p[tile * outputs..]);
                    keep_adjoint(simd, outputs, array::from_fn::<_, KEPT, _>(column), into);
                    tile += 1;
                }
            }
        }
    }
}

/// Of d in a row, each `length` numbers, what the products are made of.
#[inline(always)]
fn combine<S: Simd, T: Element>(simd: S, length: usize, d: [&[T]; POINTS], into: [&mut [T]; POINTS]) {
    let count = length.div_ceil(Vector::<S, T>::COUNT);
    let d = registers(simd, d, count);
    let into = registers_mut(simd, into, count);
    for i in 0..count {
        let [d0, d1, d2, d3] = Vector::<S, T>::from_registers(simd, [d[0][i], d[1][i], d[2][i], d[3][i]]);
        into[0][i] = (d0 - d2).register();
        into[1][i] = (d1 + d2).register();
        into[2][i] = (d2 - d1).register();
        into[3][i] = (d1 - d3).register();
    }
}

/// The same at one point alone, of d that lie one after the other.
#[inline(always)]
fn combine_at<S: Simd, T: Element>(simd: S, point: usize, length: usize, d: &[T], into: &mut [T]) {
    let (first, second, sign) = COMBINED[point];
    let count = length.div_ceil(Vector::<S, T>::COUNT);
    let d = registers(simd, [&d[first * length..], &d[second * length..]], count);
    let [into] = registers_mut(simd, [into], count);
    let sign = Vector::splat(simd, T::from_f64(sign.into()));
    for i in 0..count {
        let [first, second] = Vector::<S, T>::from_registers(simd, [d[0][i], d[1][i]]);
        into[i] = sign.mul_add(second, first).register();
    }
}

/// Adds to d̂, from what the products were made of at one point.
#[inline(always)]
fn combine_at_adjoint<S: Simd, T: Element>(simd: S, point: usize, from: &[T], d: &mut [T]) {
    let (first, second, sign) = COMBINED[point];
    let d = parts::<T, POINTS>(d);
    let sign = Vector::splat(simd, T::from_f64(sign.into()));
    for at in (0..from.len()).step_by(Vector::<S, T>::COUNT) {
        let p = Vector::load(simd, &from[at..]);
        p.add_to(&mut d[first][at..]);
        (sign * p).add_to(&mut d[second][at..]);
    }
}

/// Adds to d̂ in a row, from what the products were made of.
#[inline(always)]
fn combine_adjoint<S: Simd, T: Element>(simd: S, from: [&[T]; POINTS], d: [&mut [T]; POINTS]) {
    let [d0, d1, d2, d3] = d;
    for at in (0..d0.len()).step_by(Vector::<S, T>::COUNT) {
        let mut rest = from;
        for from in &mut rest {
            *from = &from[at..];
        }
        let [p0, p1, p2, p3] = Vector::<S, T>::load_each(simd, rest);
        p0.add_to(&mut d0[at..]);
        (p1 - p2 + p3).add_to(&mut d1[at..]);
        (p1 + p2 - p0).add_to(&mut d2[at..]);
        (Vector::splat(simd, T::ZERO) - p3).add_to(&mut d3[at..]);
    }
}

/// Of p in a row, each `length` numbers, what it adds up to.
#[inline(always)]
fn keep<S: Simd, T: Element, const KEPT: usize>(
    simd: S,
    length: usize,
    p: [&[T]; POINTS],
    into: [&mut [T]; KEPT],
    finish: impl Fn(Vector<S, T>) -> Vector<S, T>,
) {
    let count = length.div_ceil(Vector::<S, T>::COUNT);
    let p = registers(simd, p, count);
    let into = registers_mut(simd, into, count);
    for i in 0..count {
        let [p0, p1, p2, p3] = Vector::<S, T>::from_registers(simd, [p[0][i], p[1][i], p[2][i], p[3][i]]);
        let (sum, difference) = (p1 + p2, p1 - p2);
        into[0][i] = finish(p0 + sum).register();
        into[1][i] = finish(if KEPT == 2 { difference - p3 } else { difference }).register();
        if KEPT == 3 {
            into[2][i] = finish(sum - p3).register();
        }
    }
}

/// Of ŷ in a row, each `length` numbers, p̂.
#[inline(always)]
fn keep_adjoint<S: Simd, T: Element, const KEPT: usize>(
    simd: S,
    length: usize,
    y: [&[T]; KEPT],
    into: [&mut [T]; POINTS],
) {
    let count = length.div_ceil(Vector::<S, T>::COUNT);
    let y = registers(simd, y, count);
    let into = registers_mut(simd, into, count);
    for i in 0..count {
        let [first, second, last] = Vector::<S, T>::from_registers(simd, [y[0][i], y[1][i], y[KEPT - 1][i]]);
        let even = if KEPT == 2 { first } else { first + last };
        into[0][i] = first.register();
        into[1][i] = (even + second).register();
        into[2][i] = (even - second).register();
        into[3][i] = (Vector::splat(simd, T::ZERO) - last).register();
    }
}

/// The same at one point alone.
#[inline(always)]
fn keep_at_adjoint<S: Simd, T: Element, const KEPT: usize>(
    simd: S,
    point: usize,
    length: usize,
    y: [&[T]; KEPT],
    into: &mut [T],
) {
    let count = length.div_ceil(Vector::<S, T>::COUNT);
    let y = registers(simd, y, count);
    let [into] = registers_mut(simd, [into], count);
    // What p at this point is in the first, the second and the last.
    let shares = [[1.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 0.0, -1.0]][point];
    let shares = if KEPT == 2 && point != 3 { [shares[0], shares[1], 0.0] } else { shares };
    let shares = shares.map(|share| Vector::splat(simd, T::from_f64(share)));
    for i in 0..count {
        let [first, second, last] = Vector::<S, T>::from_registers(simd, [y[0][i], y[1][i], y[KEPT - 1][i]]);
        into[i] = shares[2].mul_add(last, shares[1].mul_add(second, shares[0] * first)).register();
    }
}

/// N equal parts.
#[inline(always)]
fn parts<T, const N: usize>(slice: &mut [T]) -> [&mut [T]; N] {
    let mut parts = slice.chunks_exact_mut(slice.len() / N);
    array::from_fn(|_| parts.next().unwrap_or_default())
}
