//! A convolution of the encoder, with the rectified linear unit behind it.

use super::gate::rectify;
use super::lanes::{Aligned, grown, zeros};
use super::matrix::Panels;
use super::product::{Left, multiply};
use super::real::Real;
use super::winograd::{self, Winograd};

/// Over images whose channels lie together, `[S, S, C]` to `[S', S', O]`.
#[derive(Debug)]
pub struct Convolution<T> {
    way: Way<T>,
    /// S² C.
    pub inputs: usize,
    /// S'² O.
    pub outputs: usize,
}

#[derive(Debug)]
enum Way<T> {
    Tiles(Winograd<T>),
    Patches(Patches<T>),
}

/// A product with copies of what the kernel sees, for kernels that tiles do not suit.
#[derive(Debug)]
struct Patches<T> {
    /// Where each of them begins, `[S' S']`.
    starts: Vec<usize>,
    /// Where its numbers lie from there on, `[K K C]`.
    places: Vec<usize>,
    /// `[K K C, O]`.
    weight: Panels<T>,
    /// `[O]`.
    bias: Vec<T>,
}

/// Room for what lies between images and outputs, kept from layer to layer.
#[derive(Debug)]
pub struct Room<T> {
    tiles: winograd::Room<T>,
    /// `[S' S', K K C]`.
    patches: Aligned<T>,
}

impl<T: Real> Room<T> {
    /// Empty.
    pub fn new() -> Self {
        Self { tiles: winograd::Room::new(), patches: zeros(0) }
    }
}

impl<T: Real> Convolution<T> {
    /// Of S = `side` and C = `channels`, with `weight`, `[O, C, K, K]`, and `bias`, `[O]`.
    pub fn new((side, channels): (usize, usize), (kernel, stride): (usize, usize), weight: &[T], bias: &[T]) -> Self {
        let size = (side - kernel) / stride + 1;
        let way = Winograd::new((side, channels), (kernel, stride), weight, bias)
            .map_or_else(|| Way::Patches(Patches::new((side, channels), (kernel, stride), weight, bias)), Way::Tiles);
        Self { way, inputs: side * side * channels, outputs: size * size * bias.len() }
    }

    /// Images `[R, S, S, C]`, with [`winograd::BEYOND`] numbers behind them, to `[R, S', S', O]`.
    pub fn forward(&self, x: &[T], y: &mut [T], room: &mut Room<T>) {
        match &self.way {
            Way::Tiles(tiles) => tiles.forward(x, y, &mut room.tiles),
            Way::Patches(patches) => {
                for (x, y) in x.chunks_exact(self.inputs).zip(y.chunks_exact_mut(self.outputs)) {
                    patches.forward(x, y, &mut room.patches);
                }
            }
        }
    }
}

impl<T: Real> Patches<T> {
    fn new((side, channels): (usize, usize), (kernel, stride): (usize, usize), weight: &[T], bias: &[T]) -> Self {
        let size = (side - kernel) / stride + 1;
        let starts = (0..size).flat_map(|top| (0..size).map(move |left| (top * side + left) * stride * channels));
        let places = (0..kernel).flat_map(|row| (0..kernel * channels).map(move |at| row * side * channels + at));
        Self {
            starts: starts.collect(),
            places: places.collect(),
            weight: Panels::transposed(&turn(weight, channels, kernel * kernel), kernel * kernel * channels),
            bias: bias.to_vec(),
        }
    }

    /// An image `[S, S, C]` to `[S', S', O]`.
    fn forward(&self, x: &[T], y: &mut [T], patches: &mut Aligned<T>) {
        let Self { starts, places, weight, bias } = self;
        let patches = grown(patches, starts.len() * places.len());
        for (patch, start) in patches.chunks_exact_mut(places.len()).zip(starts) {
            patch.iter_mut().zip(places).for_each(|(number, place)| *number = x[start + place]);
        }
        y.chunks_exact_mut(bias.len()).for_each(|y| y.copy_from_slice(bias));
        multiply(true, y, Left::Rows(patches), weight.matrix(0..bias.len()));
        rectify(y);
    }
}

/// Rows `[C, P]`, one after the other, as rows `[P, C]`.
pub fn turn<T: Real>(rows: &[T], channels: usize, positions: usize) -> Vec<T> {
    let row = |row: &[T]| {
        let at = (0..positions).flat_map(|p| (0..channels).map(move |c| c * positions + p));
        at.map(|at| row[at]).collect::<Vec<_>>()
    };
    rows.chunks_exact(channels * positions).flat_map(row).collect()
}
