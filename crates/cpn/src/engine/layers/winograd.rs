//! Winograd convolution, or minimal filtering: a convolution with fewer products (Lavin and Gray, arXiv 1509.09308).
//!
//! A kernel of r = 2 or 3 strides has r taps in each direction, and a tap has the weights of a block of stride x stride pixels.
//! [Tiles](super::winograd_transform) of 4 x 4 blocks give m x m outputs, m = 5 - r, by 16 products for each pair of channels,
//! instead of 36 with patches. Each product is a linear layer, whose weights are linear combinations of taps.

use super::conv2d_params::Conv2dParams;
use super::linear::{Linear, LinearGradient};
use super::passes::Stacked;
use super::winograd_transform::{ONES, PADDING, PAIRS, POINTS, Tiling};
use crate::engine::simd::buffer::{AlignedVec, resize, zeros};
use crate::engine::simd::element::{Element, Operand};
use std::array;

/// Number of tiles in a product, rounded up to whole images: more tiles read the weights less often, and fewer keep the
/// intermediates in nearer caches.
const TILES_AT_ONCE: usize = 64;

/// A convolution with a rectified linear unit over images `[S, S, C]`, channels last; E is the operand type of its products.
#[derive(Debug)]
pub struct Winograd<E: Operand> {
    tiling: Tiling,
    /// r, the number of taps in each direction.
    taps: usize,
    /// g at each pair of points, from D = stride² C to O. The bias is in the pair of ones, which contributes to each output with
    /// coefficient one.
    points: Vec<PointLinear<E>>,
}

type PointLinear<E> = Linear<E, <E as Operand>::Sum>;

/// Workspace for intermediates between images and outputs.
#[derive(Debug)]
pub struct WinogradWorkspace<E: Operand> {
    tiles: TileBuffers<E::Sum>,
    /// d and p as packed operands, if a conversion is needed.
    packed: [AlignedVec<E>; 2],
}

#[derive(Debug)]
struct TileBuffers<T> {
    /// Workspace of the transforms.
    transforms: AlignedVec<T>,
    /// d or d̂ at one vertical point, `[tiles, D]` and [`PADDING`] for each horizontal point.
    d: AlignedVec<T>,
    /// p or p̂, `[tiles, O]` for each pair of points.
    p: AlignedVec<T>,
}

/// The product at a pair of points: p `[tiles, O]` of d `[tiles, D]` times g.
struct PointProduct<'a, E: Operand> {
    pair: usize,
    layer: &'a PointLinear<E>,
    d: &'a mut [E::Sum],
    p: &'a mut [E::Sum],
}

impl<E: Operand> WinogradWorkspace<E> {
    /// An empty workspace, which grows on use.
    pub fn new() -> Self {
        let tiles = TileBuffers { transforms: zeros(0), d: zeros(0), p: zeros(0) };
        Self { tiles, packed: [zeros(0), zeros(0)] }
    }
}

impl<T: Element, E: Operand<Sum = T>> Winograd<E> {
    /// A convolution of `weight`, `[O, C, K, K]`, and `bias`, `[O]`; `None` for sizes that minimal filtering does not support.
    pub fn new(params: Conv2dParams, weight: &[T], bias: &[T]) -> Option<Self> {
        let Conv2dParams { channels, kernel, stride, .. } = params;
        let taps = kernel / stride;
        let can_pack = (stride * stride * channels).is_multiple_of(E::PACK);
        if !can_pack || kernel != taps * stride || !(2..=3).contains(&taps) || !bias.len().is_multiple_of(PADDING) {
            return None;
        }
        let tiling = Tiling::new(params, POINTS + 1 - taps, bias.len())?;

        // The kernel transform, first vertically, then horizontally.
        let tap = |i, j| tap_indices(&tiling, taps, i, j).into_iter().map(|index| weight[index]).collect();
        let down: Vec<_> = (0..taps).map(|j| at_points((0..taps).map(|i| tap(i, j)).collect())).collect();
        let across = |i: usize| at_points(down.iter().map(|points| points[i].clone()).collect());
        let bias = |pair| if pair == ONES { bias.to_vec() } else { vec![T::ZERO; bias.len()] };
        let points = (0..POINTS).flat_map(across).enumerate().map(|(pair, g)| Linear::new(&g, bias(pair))).collect();
        Some(Self { tiling, taps, points })
    }

    /// y `[R, S', S', O]` of images x `[R, S, S, C]`, followed by [`PADDING`].
    pub fn forward(&self, x: &[T], y: &mut [T], workspace: &mut WinogradWorkspace<E>) {
        let [inputs, outputs] = self.tiling.sizes();
        let images = self.images();
        for (i, y) in y.chunks_mut(images * outputs).enumerate() {
            let [transforms, d, p] = self.buffers(y.len() / outputs, &mut workspace.tiles);
            for (point, p) in p.chunks_exact_mut(p.len() / POINTS).enumerate() {
                self.tiling.input_transform(point, &x[i * images * inputs..], d, transforms);
                for PointProduct { pair, layer, d, p } in self.products(point, d, p) {
                    let d = E::pack_along_k(d, &mut workspace.packed[0]);
                    if pair == ONES {
                        layer.forward(d, p);
                    } else {
                        layer.jvp(d, p);
                    }
                }
            }
            self.tiling.output_transform(p, y, transforms);
        }
    }

    /// First-order backward pass from ŷ, the gradient before the rectified linear unit: adds to the weights' gradient, and writes
    /// x̂ if given.
    pub fn vjp(
        &self,
        x: &[T],
        y_hat: &[T],
        x_hat: Option<&mut [T]>,
        gradient: &mut [LinearGradient<T>],
        workspace: &mut WinogradWorkspace<E>,
    ) {
        let [inputs, outputs] = self.tiling.sizes();
        let images = self.images();
        let mut x_hats = x_hat.map(|x_hat| x_hat.chunks_mut(images * inputs));
        for (i, y_hat) in y_hat.chunks(images * outputs).enumerate() {
            let mut x_hat = x_hats.as_mut().and_then(Iterator::next);
            if let Some(x_hat) = &mut x_hat {
                x_hat.fill(T::ZERO);
            }
            let [transforms, d, p] = self.buffers(y_hat.len() / outputs, &mut workspace.tiles);
            let [packed_d, packed_p] = &mut workspace.packed;

            let (p, _) = p.split_at_mut(p.len() / POINTS);
            for point in 0..POINTS {
                // d is recomputed: stored, it would take up to three times the memory of the images.
                self.tiling.input_transform(point, &x[i * images * inputs..], d, transforms);
                self.tiling.output_adjoint(point, y_hat, p, transforms);
                for PointProduct { pair, layer, d, p } in self.products(point, d, p) {
                    let x = E::pack_row_pairs(d, layer.inputs, packed_d);
                    let y = E::pack_row_pairs(p, layer.outputs, packed_p);
                    layer.accumulate(Stacked { x, y }, &mut gradient[pair]);
                    if pair == ONES {
                        gradient[pair].add_bias(p);
                    }
                    if x_hat.is_some() {
                        layer.vjp(E::pack_along_k(p, packed_p), d);
                    }
                }
                if let Some(x_hat) = &mut x_hat {
                    self.tiling.input_adjoint(point, d, x_hat, transforms);
                }
            }
        }
    }

    /// A zero gradient.
    pub fn gradient(&self) -> Vec<LinearGradient<T>> {
        self.points.iter().map(Linear::gradient).collect()
    }

    /// A gradient in the checkpoint's layout: weight `[O, C, K, K]` and bias `[O]`.
    pub fn in_weights(&self, gradient: &[LinearGradient<T>]) -> [Vec<T>; 2] {
        let across = |i: usize| in_taps(self.taps, array::from_fn(|j| &gradient[i * POINTS + j].weight[..]));
        let across: [Vec<Vec<T>>; POINTS] = array::from_fn(across);
        let mut weight = vec![T::ZERO; self.taps * self.taps * gradient[ONES].weight.len()];
        let down = (0..self.taps).map(|j| in_taps(self.taps, array::from_fn(|i| &across[i][j][..])));
        for (j, taps) in down.enumerate() {
            for (i, tap) in taps.into_iter().enumerate() {
                let indices = tap_indices(&self.tiling, self.taps, i, j);
                indices.into_iter().zip(tap).for_each(|(index, g)| weight[index] = g);
            }
        }
        [weight, gradient[ONES].bias.to_vec()]
    }

    /// Number of images in a product.
    fn images(&self) -> usize {
        TILES_AT_ONCE.div_ceil(self.tiling.in_image())
    }

    /// Workspace of the transforms, d and p, for a number of images.
    fn buffers<'a>(&self, images: usize, buffers: &'a mut TileBuffers<T>) -> [&'a mut [T]; 3] {
        let (tiles, layer) = (images * self.tiling.in_image(), &self.points[0]);
        let transforms = resize(&mut buffers.transforms, self.tiling.workspace_len());
        let d = resize(&mut buffers.d, POINTS * (tiles * layer.inputs + PADDING));
        [transforms, d, resize(&mut buffers.p, PAIRS * tiles * layer.outputs)]
    }

    /// The products at one vertical point and each horizontal point.
    fn products<'a>(
        &'a self,
        point: usize,
        d: &'a mut [T],
        p: &'a mut [T],
    ) -> impl Iterator<Item = PointProduct<'a, E>> {
        let (size, stride) = (d.len() / POINTS - PADDING, p.len() / POINTS);
        let d = d.chunks_exact_mut(size + PADDING).map(move |d| &mut d[..size]);
        let layers = self.points.iter().enumerate().skip(point * POINTS);
        layers.zip(d.zip(p.chunks_exact_mut(stride))).map(|((pair, layer), (d, p))| PointProduct { pair, layer, d, p })
    }
}

/// Indices in `[O, C, K, K]` of the weights of a tap, `[O, D]`, the i-th vertically and the j-th horizontally.
fn tap_indices(tiling: &Tiling, taps: usize, i: usize, j: usize) -> Vec<usize> {
    let &Tiling { channels, stride, outputs, .. } = tiling;
    let kernel = taps * stride;
    let mut indices = Vec::with_capacity(outputs * stride * stride * channels);
    for o in 0..outputs {
        for y in i * stride..(i + 1) * stride {
            for x in j * stride..(j + 1) * stride {
                indices.extend((0..channels).map(|c| ((o * channels + c) * kernel + y) * kernel + x));
            }
        }
    }
    indices
}

/// The kernel transform: g(t) = Σ gᵢ tⁱ of two or three taps at each point, halved at 1 and -1; at ∞ the last tap.
fn at_points<T: Element>(taps: Vec<Vec<T>>) -> [Vec<T>; POINTS] {
    let (first, second, last) = (&taps[0], &taps[1], &taps[taps.len() - 1]);
    let even = if taps.len() == 2 { first } else { &sums(first, last) };
    let [one, minus_one] = halves(even, second);
    [first.clone(), one, minus_one, last.clone()]
}

/// The adjoint of [`at_points`]: the gradient in each tap, from the gradient in g at each point.
fn in_taps<T: Element>(taps: usize, [zero, one, minus_one, infinity]: [&[T]; POINTS]) -> Vec<Vec<T>> {
    let [even, odd] = halves(one, minus_one);
    if taps == 2 {
        vec![sums(zero, &even), sums(&odd, infinity)]
    } else {
        vec![sums(zero, &even), odd, sums(&even, infinity)]
    }
}

/// a + b.
fn sums<T: Element>(a: &[T], b: &[T]) -> Vec<T> {
    a.iter().zip(b).map(|(a, b)| *a + *b).collect()
}

/// (a + b) / 2 and (a - b) / 2.
fn halves<T: Element>(a: &[T], b: &[T]) -> [Vec<T>; 2] {
    let half = T::ONE / T::count(2);
    let pairs = || a.iter().zip(b);
    [pairs().map(|(a, b)| (*a + *b) * half).collect(), pairs().map(|(a, b)| (*a - *b) * half).collect()]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(count: usize, seed: usize) -> Vec<f64> {
        (0..count).map(|i| ((i * 7919 + seed * 104_729) % 97) as f64 - 48.0).collect()
    }

    fn dot(a: &[f64], b: &[f64]) -> f64 {
        a.iter().zip(b).map(|(a, b)| a * b).sum()
    }

    #[test]
    fn the_kernel_transform_is_a_polynomial_at_its_points() {
        for count in [2, 3] {
            let taps: Vec<_> = (0..count).map(|i| numbers(5, i)).collect();
            let points = at_points(taps.clone());
            for i in 0..5 {
                let g = |t: f64| taps.iter().rev().fold(0.0, |sum, tap| sum * t + tap[i]);
                let expected = [g(0.0), g(1.0) / 2.0, g(-1.0) / 2.0, taps[count - 1][i]];
                assert_eq!(points.each_ref().map(|point| point[i]), expected);
            }
        }
    }

    /// For all taps and gradients, (points of taps) · gradients = taps · (adjoint of gradients).
    #[test]
    fn in_taps_is_the_adjoint_of_the_kernel_transform() {
        for count in [2, 3] {
            let taps: Vec<_> = (0..count).map(|i| numbers(5, i)).collect();
            let gradients: [Vec<f64>; POINTS] = array::from_fn(|i| numbers(5, 10 + i));
            let points = at_points(taps.clone());
            let adjoint = in_taps(count, gradients.each_ref().map(|gradient| &gradient[..]));
            assert_eq!(adjoint.len(), count);
            let forward: f64 = points.iter().zip(&gradients).map(|(point, gradient)| dot(point, gradient)).sum();
            let backward: f64 = taps.iter().zip(&adjoint).map(|(tap, gradient)| dot(tap, gradient)).sum();
            assert_eq!(forward, backward, "{count} taps");
        }
    }

    #[test]
    fn other_kernels_are_left_to_patches() {
        for (side, kernel, stride, outputs) in
            [(9, 1, 1, 16), (9, 4, 1, 16), (9, 5, 2, 16), (9, 3, 1, 15), (3, 2, 1, 16)]
        {
            let params = Conv2dParams { side, channels: 1, kernel, stride };
            let (weight, bias) = (numbers(outputs * kernel * kernel, 1), numbers(outputs, 2));
            assert!(Winograd::<f64>::new(params, &weight, &bias).is_none(), "{params:?}, {outputs} outputs");
        }
    }
}
