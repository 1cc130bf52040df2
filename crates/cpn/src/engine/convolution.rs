//! A convolution of the encoder, with the rectified linear unit behind it.

use super::linear::{Linear, LinearGradient};
use super::rectified::rectify;
use crate::engine::simd::buffer::{AlignedVec, resize, zeros};
use crate::engine::simd::element::Element;
use super::winograd::Winograd;
use crate::engine::winograd;
use crate::encoder::Precision;

/// Over images whose channels lie together, `[S, S, C]` to `[S', S', O]`.
#[derive(Debug)]
pub struct Convolution<T: Element> {
    way: Way<T>,
    /// S² C.
    pub inputs: usize,
    /// S'² O.
    pub outputs: usize,
}

#[derive(Debug)]
enum Way<T: Element> {
    Tiles(Winograd<T>),
    HalfTiles(Winograd<T::Half>),
    Patches(Patches<T>),
}

/// A linear layer of copies of what the kernel sees, for kernels that tiles do not suit.
#[derive(Debug)]
struct Patches<T> {
    /// Where each of them begins, `[S' S']`.
    starts: Vec<usize>,
    /// Where its numbers lie from there on, `[K K C]`.
    places: Vec<usize>,
    /// C.
    channels: usize,
    /// From K K C to O.
    linear: Linear<T>,
}

/// Room for what lies between images and outputs, kept from layer to layer.
#[derive(Debug)]
pub struct Room<T: Element> {
    tiles: winograd::Room<T>,
    half_tiles: winograd::Room<T::Half>,
    /// `[S' S', K K C]`.
    patches: AlignedVec<T>,
}

impl<T: Element> Room<T> {
    /// Empty.
    pub fn new() -> Self {
        Self { tiles: winograd::Room::new(), half_tiles: winograd::Room::new(), patches: zeros(0) }
    }
}

impl<T: Element> Convolution<T> {
    /// Of S = `side` and C = `channels`, with `weight`, `[O, C, K, K]`, and `bias`, `[O]`; patches are always whole.
    pub fn new(
        (side, channels): (usize, usize),
        (kernel, stride): (usize, usize),
        (weight, bias): (&[T], &[T]),
        precision: Precision,
    ) -> Self {
        let size = (side - kernel) / stride + 1;
        let (image, window) = ((side, channels), (kernel, stride));
        let half = (precision == Precision::Bfloat16).then(|| Winograd::new(image, window, weight, bias)).flatten();
        let way = half
            .map(Way::HalfTiles)
            .or_else(|| Winograd::new(image, window, weight, bias).map(Way::Tiles))
            .unwrap_or_else(|| Way::Patches(Patches::new(image, window, weight, bias)));
        Self { way, inputs: side * side * channels, outputs: size * size * bias.len() }
    }

    /// Images `[R, S, S, C]`, with [`BEYOND`](super::tiles::BEYOND) numbers behind them, to `[R, S', S', O]`.
    pub fn forward(&self, x: &[T], y: &mut [T], room: &mut Room<T>) {
        match &self.way {
            Way::Tiles(tiles) => tiles.forward(x, y, &mut room.tiles),
            Way::HalfTiles(tiles) => tiles.forward(x, y, &mut room.half_tiles),
            Way::Patches(patches) => {
                for (x, y) in x.chunks_exact(self.inputs).zip(y.chunks_exact_mut(self.outputs)) {
                    patches.linear.forward(patches.copied(x, &mut room.patches), y);
                    rectify(y);
                }
            }
        }
    }

    /// Adds to the gradient what ŷ gives, which is a gradient in what the unit takes, and writes x̂ if it is asked for.
    pub fn adjoint(
        &self,
        (x, y_hat): (&[T], &[T]),
        mut x_hat: Option<&mut [T]>,
        gradient: &mut [LinearGradient<T>],
        room: &mut Room<T>,
    ) {
        match &self.way {
            Way::Tiles(tiles) => tiles.adjoint((x, y_hat), x_hat, gradient, &mut room.tiles),
            Way::HalfTiles(tiles) => tiles.adjoint((x, y_hat), x_hat, gradient, &mut room.half_tiles),
            Way::Patches(patches) => {
                for (i, (x, y_hat)) in x.chunks_exact(self.inputs).zip(y_hat.chunks_exact(self.outputs)).enumerate() {
                    let x_hat = x_hat.as_mut().map(|x_hat| &mut x_hat[i * self.inputs..][..self.inputs]);
                    patches.adjoint((x, y_hat), x_hat, &mut gradient[0], &mut room.patches);
                }
            }
        }
    }

    /// A gradient of zeros, in the layers that the convolution is made of.
    pub fn gradient(&self) -> Vec<LinearGradient<T>> {
        match &self.way {
            Way::Tiles(tiles) => tiles.gradient(),
            Way::HalfTiles(tiles) => tiles.gradient(),
            Way::Patches(patches) => vec![patches.linear.gradient()],
        }
    }

    /// A gradient as one in `[O, C, K, K]`, and in `[O]`.
    pub fn in_weights(&self, gradient: &[LinearGradient<T>]) -> [Vec<T>; 2] {
        match &self.way {
            Way::Tiles(tiles) => tiles.in_weights(gradient),
            Way::HalfTiles(tiles) => tiles.in_weights(gradient),
            Way::Patches(Patches { places, channels, .. }) => {
                let LinearGradient { weight, bias } = &gradient[0];
                [turn(weight, places.len() / channels, *channels), bias.to_vec()]
            }
        }
    }
}

impl<T: Element> Patches<T> {
    fn new((side, channels): (usize, usize), (kernel, stride): (usize, usize), weight: &[T], bias: &[T]) -> Self {
        let size = (side - kernel) / stride + 1;
        let starts = (0..size).flat_map(|top| (0..size).map(move |left| (top * side + left) * stride * channels));
        let places = (0..kernel).flat_map(|row| (0..kernel * channels).map(move |at| row * side * channels + at));
        Self {
            starts: starts.collect(),
            places: places.collect(),
            channels,
            linear: Linear::new(&turn(weight, channels, kernel * kernel), bias.to_vec()),
        }
    }

    /// What the kernel sees of an image `[S, S, C]`.
    fn copied<'a>(&self, x: &[T], patches: &'a mut AlignedVec<T>) -> &'a mut [T] {
        let Self { starts, places, .. } = self;
        let patches = resize(patches, starts.len() * places.len());
        for (patch, start) in patches.chunks_exact_mut(places.len()).zip(starts) {
            patch.iter_mut().zip(places).for_each(|(number, place)| *number = x[start + place]);
        }
        patches
    }

    fn adjoint(
        &self,
        (x, y_hat): (&[T], &[T]),
        x_hat: Option<&mut [T]>,
        gradient: &mut LinearGradient<T>,
        patches: &mut AlignedVec<T>,
    ) {
        let Self { starts, places, linear, .. } = self;
        let patches = self.copied(x, patches);
        linear.accumulate_all(starts.len(), (patches, y_hat), gradient);
        let Some(x_hat) = x_hat else { return };
        linear.backward(y_hat, patches);
        x_hat.fill(T::ZERO);
        for (patch, start) in patches.chunks_exact(places.len()).zip(starts) {
            patch.iter().zip(places).for_each(|(number, place)| x_hat[start + place] += *number);
        }
    }
}

/// Rows `[C, P]`, one after the other, as rows `[P, C]`.
pub fn turn<T: Element>(rows: &[T], channels: usize, positions: usize) -> Vec<T> {
    let mut turned = Vec::with_capacity(rows.len());
    for row in rows.chunks_exact(channels * positions) {
        for p in 0..positions {
            turned.extend((0..channels).map(|c| row[c * positions + p]));
        }
    }
    turned
}
