//! Convolutions by fewer products: minimal filtering after Winograd (Lavin and Gray, arXiv 1509.09308).
//!
//! A kernel as wide as r = 2 or 3 strides has r taps in either direction, each of which weighs a block of stride x stride pixels.
//! [Tiles](super::tiles) of 4 x 4 blocks give m x m outputs, m = 5 - r, by 16 products for each pair of channels, where patches
//! take 36: each is a linear layer of its own, whose weights are sums of taps.

use super::linear::{Linear, LinearGradient};
use crate::engine::simd::buffer::{AlignedVec, resize, zeros};
use crate::engine::simd::element::{Element, Operand};
use super::tiles::{BEYOND, ONES, PAIRS, POINTS, Tiles};
use std::array;

/// Of as many images as have so many tiles, those are multiplied at once: with more of them weights are read less often, with
/// fewer the products lie nearer.
const AT_ONCE: usize = 64;

/// A convolution over images whose channels lie together, `[S, S, C]`, and a rectified linear unit; E is what is multiplied.
#[derive(Debug)]
pub struct Winograd<E: Operand> {
    tiles: Tiles,
    /// r.
    taps: usize,
    /// At each pair of points g, from D = stride² C to O; and at 1 in both directions, which every output has once, the bias.
    points: Vec<Layer<E>>,
}

type Layer<E> = Linear<E, <E as Operand>::Sum>;

/// Room for what lies between an image and its outputs, kept from image to image.
#[derive(Debug)]
pub struct Room<E: Operand> {
    numbers: Numbers<E::Sum>,
    /// d and p as factors, if they are not multiplied as they are.
    factors: [AlignedVec<E>; 2],
}

#[derive(Debug)]
struct Numbers<T> {
    /// What [`Tiles`] works in.
    tiles: AlignedVec<T>,
    /// d or d̂, down at one point, for each across `[tiles, D]`, with [`BEYOND`] numbers behind them.
    d: AlignedVec<T>,
    /// p or p̂, for each pair of points `[tiles, O]`.
    p: AlignedVec<T>,
}

impl<E: Operand> Room<E> {
    /// Empty.
    pub fn new() -> Self {
        Self { numbers: Numbers { tiles: zeros(0), d: zeros(0), p: zeros(0) }, factors: [zeros(0), zeros(0)] }
    }
}

impl<T: Element, E: Operand<Sum = T>> Winograd<E> {
    /// Of S = `side` and C = `channels`, with `weight`, `[O, C, K, K]`, and `bias`, `[O]`; None where this does not apply.
    pub fn new(
        (side, channels): (usize, usize),
        (kernel, stride): (usize, usize),
        weight: &[T],
        bias: &[T],
    ) -> Option<Self> {
        let taps = kernel / stride;
        let are_factors = (stride * stride * channels).is_multiple_of(E::PACK);
        if !are_factors || kernel != taps * stride || !(2..=3).contains(&taps) || !bias.len().is_multiple_of(BEYOND) {
            return None;
        }
        let tiles = Tiles::new((side, channels), stride, POINTS + 1 - taps, bias.len())?;
        let tap = |i, j| places(&tiles, taps, (i, j)).into_iter().map(|place| weight[place]).collect();
        let down: Vec<_> = (0..taps).map(|j| at_points((0..taps).map(|i| tap(i, j)).collect())).collect();
        let across = |i: usize| at_points(down.iter().map(|points| points[i].clone()).collect());
        let bias = |pair| if pair == ONES { bias.to_vec() } else { vec![T::ZERO; bias.len()] };
        let points = (0..POINTS).flat_map(across).enumerate().map(|(pair, g)| Linear::new(&g, bias(pair))).collect();
        Some(Self { tiles, taps, points })
    }

    /// Images `[R, S, S, C]`, with [`BEYOND`] numbers behind them, to `[R, S', S', O]`.
    pub fn forward(&self, x: &[T], y: &mut [T], room: &mut Room<E>) {
        let [inputs, outputs] = self.tiles.sizes();
        let images = self.images();
        for (i, y) in y.chunks_mut(images * outputs).enumerate() {
            let [inner, d, p] = self.room(y.len() / outputs, &mut room.numbers);
            for (point, p) in p.chunks_exact_mut(p.len() / POINTS).enumerate() {
                self.tiles.enter(point, &x[i * images * inputs..], d, inner);
                for (pair, layer, (d, p)) in self.layers(point, d, p) {
                    let d = E::pack_along_k(d, &mut room.factors[0]);
                    if pair == ONES {
                        layer.forward(d, p);
                    } else {
                        layer.tangent(d, p);
                    }
                }
            }
            self.tiles.leave(p, y, inner);
        }
    }

    /// Adds to the gradient what ŷ gives, which is a gradient in what the unit takes, and writes x̂ if it is asked for.
    pub fn adjoint(
        &self,
        (x, y_hat): (&[T], &[T]),
        x_hat: Option<&mut [T]>,
        gradient: &mut [LinearGradient<T>],
        room: &mut Room<E>,
    ) {
        let [inputs, outputs] = self.tiles.sizes();
        let images = self.images();
        let mut x_hats = x_hat.map(|x_hat| x_hat.chunks_mut(images * inputs));
        for (i, y_hat) in y_hat.chunks(images * outputs).enumerate() {
            let mut x_hat = x_hats.as_mut().and_then(Iterator::next);
            if let Some(x_hat) = &mut x_hat {
                x_hat.fill(T::ZERO);
            }
            let [inner, d, p] = self.room(y_hat.len() / outputs, &mut room.numbers);
            let [in_d, in_p] = &mut room.factors;
            let (p, _) = p.split_at_mut(p.len() / POINTS);
            for point in 0..POINTS {
                self.tiles.enter(point, &x[i * images * inputs..], d, inner);
                self.tiles.leave_adjoint(point, y_hat, p, inner);
                for (pair, layer, (d, p)) in self.layers(point, d, p) {
                    let factors = (E::pack_row_pairs(d, layer.inputs, in_d), E::pack_row_pairs(p, layer.outputs, in_p));
                    layer.accumulate(factors, &mut gradient[pair]);
                    if pair == ONES {
                        gradient[pair].add_bias(p);
                    }
                    if x_hat.is_some() {
                        layer.backward(E::pack_along_k(p, in_p), d);
                    }
                }
                if let Some(x_hat) = &mut x_hat {
                    self.tiles.enter_adjoint(point, d, x_hat, inner);
                }
            }
        }
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> Vec<LinearGradient<T>> {
        self.points.iter().map(Linear::gradient).collect()
    }

    /// A gradient as one in `[O, C, K, K]`, and in `[O]`.
    pub fn in_weights(&self, gradient: &[LinearGradient<T>]) -> [Vec<T>; 2] {
        let across = |i: usize| in_taps(self.taps, array::from_fn(|j| &gradient[i * POINTS + j].weight[..]));
        let across: [Vec<Vec<T>>; POINTS] = array::from_fn(across);
        let mut weight = vec![T::ZERO; self.taps * self.taps * gradient[ONES].weight.len()];
        let down = (0..self.taps).map(|j| in_taps(self.taps, array::from_fn(|i| &across[i][j][..])));
        for (j, taps) in down.enumerate() {
            for (i, tap) in taps.into_iter().enumerate() {
                places(&self.tiles, self.taps, (i, j)).into_iter().zip(tap).for_each(|(place, g)| weight[place] = g);
            }
        }
        [weight, gradient[ONES].bias.to_vec()]
    }

    /// That go through at once.
    fn images(&self) -> usize {
        AT_ONCE.div_ceil(self.tiles.in_image())
    }

    fn room<'a>(&self, images: usize, room: &'a mut Numbers<T>) -> [&'a mut [T]; 3] {
        let (tiles, layer) = (images * self.tiles.in_image(), &self.points[0]);
        let d = resize(&mut room.d, POINTS * (tiles * layer.inputs + BEYOND));
        [resize(&mut room.tiles, self.tiles.room()), d, resize(&mut room.p, PAIRS * tiles * layer.outputs)]
    }

    /// The layers, down at one point, with what belongs to them, and which of all pairs they are of.
    fn layers<'a>(
        &'a self,
        point: usize,
        d: &'a mut [T],
        p: &'a mut [T],
    ) -> impl Iterator<Item = (usize, &'a Layer<E>, (&'a mut [T], &'a mut [T]))> {
        let (size, apart) = (d.len() / POINTS - BEYOND, p.len() / POINTS);
        let d = d.chunks_exact_mut(size + BEYOND).map(move |d| &mut d[..size]);
        let layers = self.points.iter().enumerate().skip(point * POINTS);
        layers.zip(d.zip(p.chunks_exact_mut(apart))).map(|((pair, layer), parts)| (pair, layer, parts))
    }
}

/// Where the weights of a tap, `[O, D]`, stand in `[O, C, K, K]`.
fn places(tiles: &Tiles, taps: usize, (i, j): (usize, usize)) -> Vec<usize> {
    let &Tiles { channels, stride, outputs, .. } = tiles;
    let kernel = taps * stride;
    let mut places = Vec::with_capacity(outputs * stride * stride * channels);
    for o in 0..outputs {
        for y in i * stride..(i + 1) * stride {
            for x in j * stride..(j + 1) * stride {
                places.extend((0..channels).map(|c| ((o * channels + c) * kernel + y) * kernel + x));
            }
        }
    }
    places
}

/// g(t) = Σ gᵢ tⁱ of two or three taps at each point, halved at 1 and -1; at ∞ it is the last tap.
fn at_points<T: Element>(taps: Vec<Vec<T>>) -> [Vec<T>; POINTS] {
    let (first, second, last) = (&taps[0], &taps[1], &taps[taps.len() - 1]);
    let even = if taps.len() == 2 { first } else { &sums(first, last) };
    let [one, minus_one] = halves(even, second);
    [first.clone(), one, minus_one, last.clone()]
}

/// [`at_points`] turned round: what a loss changes by with each tap, from what it changes by with g at each point.
fn in_taps<T: Element>(taps: usize, [zero, one, minus_one, infinity]: [&[T]; POINTS]) -> Vec<Vec<T>> {
    let [even, odd] = halves(one, minus_one);
    if taps == 2 {
        vec![sums(zero, &even), sums(&odd, infinity)]
    } else {
        vec![sums(zero, &even), odd, sums(&even, infinity)]
    }
}

fn sums<T: Element>(a: &[T], b: &[T]) -> Vec<T> {
    a.iter().zip(b).map(|(a, b)| *a + *b).collect()
}

/// (a + b) / 2 and (a - b) / 2.
fn halves<T: Element>(a: &[T], b: &[T]) -> [Vec<T>; 2] {
    let half = T::ONE / T::count(2);
    let pairs = || a.iter().zip(b);
    [pairs().map(|(a, b)| (*a + *b) * half).collect(), pairs().map(|(a, b)| (*a - *b) * half).collect()]
}
