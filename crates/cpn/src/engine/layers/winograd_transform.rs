//! Input and output transforms of [minimal filtering](super::winograd): sums before and after its products.
//!
//! In one direction, four blocks d give m outputs y of r = 5 - m taps by four products p, with g(t) = Σ gᵢ tⁱ and g(∞) the last
//! tap:
//!
//! - p₀ = (d₀ - d₂) g(0), p₁ = (d₁ + d₂) g(1)/2, p₂ = (d₂ - d₁) g(-1)/2, p₃ = (d₁ - d₃) g(∞)
//! - y₀ = p₀ + p₁ + p₂, then if m = 3 p₁ - p₂, and last p₁ ± p₂ - p₃, with + if m = 3
//!
//! A tile applies this in both directions. These points need only sums and halves, with almost no loss of precision in float32.
//! Each transform is linear and has an adjoint, from the gradient in its outputs to the gradient in its inputs. All but the output
//! transform process one vertical point at a time, so that the products find their operands in nearer caches.

use super::conv2d_params::Conv2dParams;
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::{Vector, registers, registers_mut};
use pulp::{Arch, Simd, WithSimd};
use std::array;

/// Number of interpolation points 0, 1, -1 and ∞, and of a tile's blocks in each direction.
pub const POINTS: usize = 4;
/// Input transform at each point: indices of its two d, and the sign of the second.
const INPUT_TERMS: [(usize, usize, i8); POINTS] = [(0, 2, -1), (1, 2, 1), (2, 1, -1), (1, 3, -1)];
/// Number of pairs of points, one for each direction.
pub const PAIRS: usize = POINTS * POINTS;
/// Index of the pair of the point 1 in both directions.
pub const ONES: usize = POINTS + 1;
/// Padding after a buffer, so that a full-width access may overrun it, in elements: the size of the widest register.
pub const PADDING: usize = 16;

/// Division of images `[S, S, C]`, and of their outputs `[S', S', O]`, into tiles.
#[derive(Debug)]
pub struct Tiling {
    /// S.
    side: usize,
    /// C.
    pub channels: usize,
    pub stride: usize,
    /// O, a multiple of [`PADDING`].
    pub outputs: usize,
    /// S'.
    size: usize,
    /// m, the number of a tile's outputs in each direction.
    tile_outputs: usize,
    /// First block, and first output, of the tiles in each direction; the last tile ends within the image, and may overlap.
    starts: Vec<usize>,
}

impl Tiling {
    /// Tiles of m x m outputs, m = `tile_outputs`; `None` if the images are smaller than a tile.
    pub fn new(params: Conv2dParams, tile_outputs: usize, outputs: usize) -> Option<Self> {
        let Conv2dParams { side, channels, stride, .. } = params;
        let size = (side / stride + tile_outputs).checked_sub(POINTS)?;
        let starts = (0..size).step_by(tile_outputs).map(|start| start.min(size - tile_outputs));
        (size >= tile_outputs).then(|| {
            let starts = starts.collect();
            Self { side, channels, stride, outputs, size, tile_outputs, starts }
        })
    }

    /// Number of tiles of an image.
    pub fn in_image(&self) -> usize {
        self.starts.len().pow(2)
    }

    /// Sizes of an image and of its outputs, in elements.
    pub fn sizes(&self) -> [usize; 2] {
        [self.side * self.side * self.channels, self.size * self.size * self.outputs]
    }

    /// Size of the transforms' workspace, in elements.
    pub fn workspace_len(&self) -> usize {
        (self.band() + PADDING).max(POINTS * self.tile_outputs * self.outputs)
    }

    /// Size of a block's part of a line, in elements.
    fn run(&self) -> usize {
        self.stride * self.channels
    }

    /// Size of a line of the image, in elements.
    fn line(&self) -> usize {
        self.side * self.channels
    }

    /// Size of the lines of a row of blocks, in elements.
    fn band(&self) -> usize {
        self.stride * self.line()
    }

    /// The input transform in both directions, of images to d at one vertical point: `[tiles, D]` and [`PADDING`] for each
    /// horizontal point. The images are followed by [`PADDING`].
    pub fn input_transform<T: Element>(&self, point: usize, x: &[T], d: &mut [T], workspace: &mut [T]) {
        Arch::new().dispatch(InputTransform { tiling: self, point, x, d, workspace });
    }

    /// The adjoint of [`Self::input_transform`]: adds the contribution of d̂ at a vertical point to x̂.
    pub fn input_adjoint<T: Element>(&self, point: usize, d: &[T], x: &mut [T], workspace: &mut [T]) {
        Arch::new().dispatch(InputAdjoint { tiling: self, point, d, x, workspace });
    }

    /// The output transform and the rectified linear unit: outputs y of p, `[tiles, O]` for each pair of points.
    pub fn output_transform<T: Element>(&self, p: &[T], y: &mut [T], workspace: &mut [T]) {
        match self.tile_outputs {
            2 => Arch::new().dispatch(OutputTransform::<T, 2> { tiling: self, p, y, workspace }),
            _ => Arch::new().dispatch(OutputTransform::<T, 3> { tiling: self, p, y, workspace }),
        }
    }

    /// The adjoint of the output transform at one vertical point: p̂ of ŷ, the gradient before the rectified linear unit.
    pub fn output_adjoint<T: Element>(&self, point: usize, y: &[T], p: &mut [T], workspace: &mut [T]) {
        match self.tile_outputs {
            2 => Arch::new().dispatch(OutputAdjoint::<T, 2> { tiling: self, point, y, p, workspace }),
            _ => Arch::new().dispatch(OutputAdjoint::<T, 3> { tiling: self, point, y, p, workspace }),
        }
    }
}

/// [`Tiling::input_transform`]. Stores of full registers overrun a line, or a block's part of it; the next store overwrites the
/// overrun.
#[derive(Debug)]
struct InputTransform<'a, T> {
    tiling: &'a Tiling,
    point: usize,
    x: &'a [T],
    d: &'a mut [T],
    workspace: &'a mut [T],
}

impl<T: Element> WithSimd for InputTransform<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { tiling: tiling @ Tiling { stride, starts, .. }, point, x, d, workspace } = self;
        let (run, line, band) = (tiling.run(), tiling.line(), tiling.band());
        let count = (d.len() / POINTS - PADDING) / (stride * run);
        let lines = &mut workspace[..band + PADDING];
        let mut d = parts::<T, POINTS>(d);
        for (row, first) in (0..count).step_by(starts.len()).enumerate() {
            let x = &x[row / starts.len() * tiling.sizes()[0] + starts[row % starts.len()] * band..];
            // Vertically for a row of tiles, then horizontally for each block.
            input_sums_at(simd, point, band, x, lines);
            for (t, left) in starts.iter().enumerate() {
                for y in 0..*stride {
                    let block = |j| &lines[y * line + (left + j) * run..];
                    let into = d.each_mut().map(|d| &mut d[((first + t) * stride + y) * run..]);
                    input_sums(simd, run, [block(0), block(1), block(2), block(3)], into);
                }
            }
        }
    }
}

/// [`Tiling::input_adjoint`].
#[derive(Debug)]
struct InputAdjoint<'a, T> {
    tiling: &'a Tiling,
    point: usize,
    d: &'a [T],
    x: &'a mut [T],
    workspace: &'a mut [T],
}

impl<T: Element> WithSimd for InputAdjoint<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { tiling: tiling @ Tiling { stride, starts, .. }, point, d, x, workspace } = self;
        let (run, line, band) = (tiling.run(), tiling.line(), tiling.band());
        let apart = d.len() / POINTS;
        let lines = &mut workspace[..band];

        // The steps of the transform in reverse.
        let mut first = 0;
        for image in x.chunks_exact_mut(tiling.sizes()[0]) {
            for top in starts {
                lines.fill(T::ZERO);
                for (t, left) in starts.iter().enumerate() {
                    for y in 0..*stride {
                        let block = |j| &d[j * apart + ((first + t) * stride + y) * run..][..run];
                        let into = parts::<T, POINTS>(&mut lines[y * line + left * run..][..POINTS * run]);
                        input_sums_adjoint(simd, [block(0), block(1), block(2), block(3)], into);
                    }
                }
                input_sums_at_adjoint(simd, point, lines, &mut image[top * band..][..POINTS * band]);
                first += starts.len();
            }
        }
    }
}

/// [`Tiling::output_transform`].
#[derive(Debug)]
struct OutputTransform<'a, T, const M: usize> {
    tiling: &'a Tiling,
    p: &'a [T],
    y: &'a mut [T],
    workspace: &'a mut [T],
}

impl<T: Element, const M: usize> WithSimd for OutputTransform<'_, T, M> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { tiling: &Tiling { size, outputs, ref starts, .. }, p, y, workspace } = self;
        let apart = p.len() / PAIRS;
        // [m, POINTS, O]
        let half = &mut workspace[..M * POINTS * outputs];
        let mut tile = 0;
        for image in y.chunks_exact_mut(size * size * outputs) {
            for (top, left) in starts.iter().flat_map(|top| starts.iter().map(move |left| (top, left))) {
                // Vertically to m rows at each point, then horizontally to m outputs of each row.
                for j in 0..POINTS {
                    let row = |i| &p[(i * POINTS + j) * apart + tile * outputs..];
                    let into = parts::<T, M>(half).map(|half| &mut half[j * outputs..]);
                    output_sums(simd, outputs, [row(0), row(1), row(2), row(3)], into, |y| y);
                }
                for (i, half) in half.chunks_exact(POINTS * outputs).enumerate() {
                    let column = |j| &half[j * outputs..];
                    let into = &mut image[((top + i) * size + left) * outputs..][..M * outputs];
                    let columns = [column(0), column(1), column(2), column(3)];
                    output_sums(simd, outputs, columns, parts::<T, M>(into), Vector::relu);
                }
                tile += 1;
            }
        }
    }
}

/// [`Tiling::output_adjoint`].
#[derive(Debug)]
struct OutputAdjoint<'a, T, const M: usize> {
    tiling: &'a Tiling,
    point: usize,
    y: &'a [T],
    p: &'a mut [T],
    workspace: &'a mut [T],
}

impl<T: Element, const M: usize> WithSimd for OutputAdjoint<'_, T, M> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { tiling: &Tiling { size, outputs, ref starts, .. }, point, y, p, workspace } = self;
        let width = M * outputs;
        // [m, O], and zeros.
        let (half, zeros) = workspace.split_at_mut(width);
        zeros[..width].fill(T::ZERO);
        let mut p = parts::<T, POINTS>(p);
        let mut tile = 0;
        for image in y.chunks_exact(size * size * outputs) {
            for (down, top) in starts.iter().enumerate() {
                for (across, left) in starts.iter().enumerate() {
                    // Outputs shared with the previous tile count for that tile only.
                    let (above, before) = (down * M - top, across * M - left);
                    let row = |i| if i < above { &*zeros } else { &image[((top + i) * size + left) * outputs..] };
                    output_sums_at_adjoint(simd, point, width, array::from_fn::<_, M, _>(row), half);
                    let column = |j| if j < before { &*zeros } else { &half[j * outputs..] };
                    let into = p.each_mut().map(|p| &mut p[tile * outputs..]);
                    output_sums_adjoint(simd, outputs, array::from_fn::<_, M, _>(column), into);
                    tile += 1;
                }
            }
        }
    }
}

/// The input transform of four d in one direction, each of `length` elements.
#[inline(always)]
fn input_sums<S: Simd, T: Element>(simd: S, length: usize, d: [&[T]; POINTS], into: [&mut [T]; POINTS]) {
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

/// [`input_sums`] at one point, of consecutive d.
#[inline(always)]
fn input_sums_at<S: Simd, T: Element>(simd: S, point: usize, length: usize, d: &[T], into: &mut [T]) {
    let (first, second, sign) = INPUT_TERMS[point];
    let count = length.div_ceil(Vector::<S, T>::COUNT);
    let d = registers(simd, [&d[first * length..], &d[second * length..]], count);
    let [into] = registers_mut(simd, [into], count);
    let sign = Vector::splat(simd, T::from_f64(sign.into()));
    for i in 0..count {
        let [first, second] = Vector::<S, T>::from_registers(simd, [d[0][i], d[1][i]]);
        into[i] = sign.mul_add(second, first).register();
    }
}

/// The adjoint of [`input_sums_at`], added to d̂.
#[inline(always)]
fn input_sums_at_adjoint<S: Simd, T: Element>(simd: S, point: usize, from: &[T], d: &mut [T]) {
    let (first, second, sign) = INPUT_TERMS[point];
    let d = parts::<T, POINTS>(d);
    let sign = Vector::splat(simd, T::from_f64(sign.into()));
    for at in (0..from.len()).step_by(Vector::<S, T>::COUNT) {
        let p = Vector::load(simd, &from[at..]);
        p.add_to(&mut d[first][at..]);
        (sign * p).add_to(&mut d[second][at..]);
    }
}

/// The adjoint of [`input_sums`], added to d̂.
#[inline(always)]
fn input_sums_adjoint<S: Simd, T: Element>(simd: S, from: [&[T]; POINTS], d: [&mut [T]; POINTS]) {
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

/// The output transform of four p in one direction, each of `length` elements, to M = m outputs, with `finish` applied to each.
#[inline(always)]
fn output_sums<S: Simd, T: Element, const M: usize>(
    simd: S,
    length: usize,
    p: [&[T]; POINTS],
    into: [&mut [T]; M],
    finish: impl Fn(Vector<S, T>) -> Vector<S, T>,
) {
    let count = length.div_ceil(Vector::<S, T>::COUNT);
    let p = registers(simd, p, count);
    let into = registers_mut(simd, into, count);
    for i in 0..count {
        let [p0, p1, p2, p3] = Vector::<S, T>::from_registers(simd, [p[0][i], p[1][i], p[2][i], p[3][i]]);
        let (sum, difference) = (p1 + p2, p1 - p2);
        into[0][i] = finish(p0 + sum).register();
        into[1][i] = finish(if M == 2 { difference - p3 } else { difference }).register();
        if M == 3 {
            into[2][i] = finish(sum - p3).register();
        }
    }
}

/// The adjoint of [`output_sums`]: p̂ of M ŷ in one direction, each of `length` elements.
#[inline(always)]
fn output_sums_adjoint<S: Simd, T: Element, const M: usize>(
    simd: S,
    length: usize,
    y: [&[T]; M],
    into: [&mut [T]; POINTS],
) {
    let count = length.div_ceil(Vector::<S, T>::COUNT);
    let y = registers(simd, y, count);
    let into = registers_mut(simd, into, count);
    for i in 0..count {
        let [first, second, last] = Vector::<S, T>::from_registers(simd, [y[0][i], y[1][i], y[M - 1][i]]);
        let even = if M == 2 { first } else { first + last };
        into[0][i] = first.register();
        into[1][i] = (even + second).register();
        into[2][i] = (even - second).register();
        into[3][i] = (Vector::splat(simd, T::ZERO) - last).register();
    }
}

/// [`output_sums_adjoint`] at one point.
#[inline(always)]
fn output_sums_at_adjoint<S: Simd, T: Element, const M: usize>(
    simd: S,
    point: usize,
    length: usize,
    y: [&[T]; M],
    into: &mut [T],
) {
    let count = length.div_ceil(Vector::<S, T>::COUNT);
    let y = registers(simd, y, count);
    let [into] = registers_mut(simd, [into], count);
    // Coefficients of p at this point in the first, second and last output.
    let shares = [[1.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 0.0, -1.0]][point];
    let shares = if M == 2 && point != 3 { [shares[0], shares[1], 0.0] } else { shares };
    let shares = shares.map(|share| Vector::splat(simd, T::from_f64(share)));
    for i in 0..count {
        let [first, second, last] = Vector::<S, T>::from_registers(simd, [y[0][i], y[1][i], y[M - 1][i]]);
        into[i] = shares[2].mul_add(last, shares[1].mul_add(second, shares[0] * first)).register();
    }
}

/// A slice in N equal parts.
#[inline(always)]
fn parts<T, const N: usize>(slice: &mut [T]) -> [&mut [T]; N] {
    let mut parts = slice.chunks_exact_mut(slice.len() / N);
    array::from_fn(|_| parts.next().unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The transforms as matrices: Bᵀ, and Aᵀ for m = 2 and 3.
    const INPUT: [[f64; POINTS]; POINTS] =
        [[1.0, 0.0, -1.0, 0.0], [0.0, 1.0, 1.0, 0.0], [0.0, -1.0, 1.0, 0.0], [0.0, 1.0, 0.0, -1.0]];
    const OUTPUT: [&[[f64; POINTS]]; 2] = [
        &[[1.0, 1.0, 1.0, 0.0], [0.0, 1.0, -1.0, -1.0]],
        &[[1.0, 1.0, 1.0, 0.0], [0.0, 1.0, -1.0, 0.0], [0.0, 1.0, 1.0, -1.0]],
    ];
    const IMAGES: usize = 2;

    /// Integers, so that sums are exact.
    fn numbers(count: usize, seed: usize) -> Vec<f64> {
        (0..count).map(|i| ((i * 7919 + seed * 104_729) % 97) as f64 - 48.0).collect()
    }

    /// Sizes with one tile, with several, and with an overlapping last one, for both numbers of outputs.
    fn tilings() -> Vec<(Conv2dParams, Tiling)> {
        let mut tilings = Vec::new();
        for (tile_outputs, side, channels, stride) in
            [(2, 4, 1, 1), (2, 5, 3, 1), (2, 11, 2, 2), (3, 4, 5, 1), (3, 9, 3, 1), (3, 13, 1, 2), (3, 18, 17, 3)]
        {
            let kernel = (POINTS + 1 - tile_outputs) * stride;
            let params = Conv2dParams { side, channels, kernel, stride };
            tilings.push((params, Tiling::new(params, tile_outputs, PADDING).unwrap_or_else(|| panic!("{params:?}"))));
        }
        tilings
    }

    /// Tiles of all images: image, index in each direction, first block in each direction.
    fn tiles(tiling: &Tiling) -> Vec<[usize; 5]> {
        let starts: Vec<_> = tiling.starts.iter().copied().enumerate().collect();
        let mut tiles = Vec::new();
        for image in 0..IMAGES {
            for (i, top) in &starts {
                tiles.extend(starts.iter().map(|(j, left)| [image, *i, *j, *top, *left]));
            }
        }
        tiles
    }

    /// Coefficients of the input transform at a vertical point: index in x, index in d and factor.
    fn input_terms(params: Conv2dParams, tiling: &Tiling, point: usize) -> Vec<(usize, usize, f64)> {
        let Conv2dParams { side, channels, stride, .. } = params;
        let (tiles, block) = (tiles(tiling), stride * stride * channels);
        let mut terms = Vec::new();
        for (j, across) in INPUT.iter().enumerate() {
            for (tile, [image, _, _, top, left]) in tiles.iter().enumerate() {
                for (a, b) in (0..POINTS).flat_map(|a| (0..POINTS).map(move |b| (a, b))) {
                    for (at, (y, x)) in (0..stride).flat_map(|y| (0..stride).map(move |x| (y, x))).enumerate() {
                        let pixel = (image * side + (top + a) * stride + y) * side + (left + b) * stride + x;
                        for c in 0..channels {
                            let d = j * (tiles.len() * block + PADDING) + tile * block + at * channels + c;
                            terms.push((pixel * channels + c, d, INPUT[point][a] * across[b]));
                        }
                    }
                }
            }
        }
        terms
    }

    #[test]
    fn the_input_transform_and_its_adjoint_are_their_matrices() {
        for (params, tiling) in tilings() {
            let size = IMAGES * tiling.sizes()[0];
            let block = params.stride * params.stride * params.channels;
            let len = POINTS * (IMAGES * tiling.in_image() * block + PADDING);
            let mut x = numbers(size, 1);
            x.extend([f64::NAN; PADDING]);
            let mut workspace = vec![f64::NAN; tiling.workspace_len()];
            for point in 0..POINTS {
                let terms = input_terms(params, &tiling, point);
                let mut expected = vec![0.0; len];
                terms.iter().for_each(|(x_at, d_at, factor)| expected[*d_at] += factor * x[*x_at]);
                let mut d = vec![f64::NAN; len];
                tiling.input_transform(point, &x, &mut d, &mut workspace);
                for (ours, expected) in d.chunks(len / POINTS).zip(expected.chunks(len / POINTS)) {
                    assert_eq!(
                        ours[..len / POINTS - PADDING],
                        expected[..len / POINTS - PADDING],
                        "{params:?} {point}"
                    );
                }

                let d_hat = numbers(len, 2);
                let mut expected = numbers(size, 3);
                let mut x_hat = expected.clone();
                terms.iter().for_each(|(x_at, d_at, factor)| expected[*x_at] += factor * d_hat[*d_at]);
                tiling.input_adjoint(point, &d_hat, &mut x_hat, &mut workspace);
                assert_eq!(x_hat, expected, "{params:?} {point}");
            }
        }
    }

    #[test]
    fn the_output_transform_and_its_adjoint_are_their_matrices() {
        for (params, tiling) in tilings() {
            let (m, outputs, size) = (tiling.tile_outputs, tiling.outputs, tiling.size);
            let (matrix, tiles) = (OUTPUT[m - 2], tiles(&tiling));
            let p = numbers(PAIRS * tiles.len() * outputs, 1);
            let y_hat = numbers(IMAGES * size * size * outputs, 2);
            let (mut expected, mut expected_p_hat) = (vec![f64::NAN; y_hat.len()], vec![0.0; p.len()]);
            for (tile, [image, i, j, top, left]) in tiles.iter().enumerate() {
                for (a, b) in (0..m).flat_map(|a| (0..m).map(move |b| (a, b))) {
                    for o in 0..outputs {
                        let at = ((image * size + top + a) * size + left + b) * outputs + o;
                        let pairs = (0..PAIRS).map(|pair| {
                            let factor = matrix[a][pair / POINTS] * matrix[b][pair % POINTS];
                            ((pair * tiles.len() + tile) * outputs + o, factor)
                        });
                        expected[at] = pairs.clone().map(|(p_at, factor)| factor * p[p_at]).sum::<f64>().max(0.0);
                        // An output of two tiles counts for the first.
                        if a >= i * m - top && b >= j * m - left {
                            pairs.for_each(|(p_at, factor)| expected_p_hat[p_at] += factor * y_hat[at]);
                        }
                    }
                }
            }

            let mut workspace = vec![f64::NAN; tiling.workspace_len()];
            let mut y = vec![f64::NAN; y_hat.len()];
            tiling.output_transform(&p, &mut y, &mut workspace);
            assert_eq!(y, expected, "{params:?}");
            for (point, expected) in expected_p_hat.chunks(p.len() / POINTS).enumerate() {
                let mut p_hat = vec![f64::NAN; expected.len()];
                tiling.output_adjoint(point, &y_hat, &mut p_hat, &mut workspace);
                assert_eq!(p_hat, expected, "{params:?} {point}");
            }
        }
    }

    #[test]
    fn images_smaller_than_a_tile_have_no_tiling() {
        for (side, tile_outputs, stride) in [(3, 2, 1), (3, 3, 1), (7, 2, 2)] {
            let params = Conv2dParams { side, channels: 1, kernel: stride, stride };
            assert!(Tiling::new(params, tile_outputs, PADDING).is_none(), "{params:?}");
        }
    }
}
