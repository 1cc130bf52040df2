//! The encoder f_φ for planning: convolutions as products with patches of the image.

use super::gate::rectify;
use super::lanes::{Aligned, zeros};
use super::linear::{Linear, Weights};
use super::matrix::Panels;
use super::product::{Left, multiply};
use super::real::Real;
use crate::config::{EncoderConfig, ImageEncoderConfig, PositionEncoderConfig};
use crate::images::{CHANNELS, SIZE};
use crate::method::Observed;
use pulp::{Arch, Simd, WithSimd};

/// What layer normalisation adds to the variance, as libtorch does.
const EPSILON: f64 = 1e-5;

/// What suits the input, then a linear layer to the embedding.
#[derive(Debug)]
pub struct Encoder<T> {
    body: Body<T>,
    linear: Linear<T>,
    norm: Option<Norm<T>>,
}

/// From the input to features.
#[derive(Debug)]
enum Body<T> {
    Image { convolutions: Vec<Convolution<T>> },
    Position { centre_metres: [f64; 3], scale_metres: T, layers: Vec<Linear<T>> },
}

/// A convolution over an image whose channels lie together, `[S, S, C]`, and a rectified linear unit.
#[derive(Debug)]
struct Convolution<T> {
    /// Where each of the patches begins, `[S' S']`.
    starts: Vec<usize>,
    /// Where its numbers lie from there on, `[K K C]`.
    places: Vec<usize>,
    /// `[K K C, O]`.
    weight: Panels<T>,
    /// `[O]`.
    bias: Vec<T>,
}

/// Layer normalisation, `[Z]`.
#[derive(Debug)]
struct Norm<T> {
    weight: Vec<T>,
    bias: Vec<T>,
}

/// Room for the passes, kept from image to image.
#[derive(Debug)]
pub struct Room<T> {
    x: Aligned<T>,
    y: Aligned<T>,
    /// Of all inputs, `[R, F]`.
    features: Aligned<T>,
}

impl<T: Real> Room<T> {
    /// Empty.
    pub fn new() -> Self {
        Self { x: zeros(0), y: zeros(0), features: zeros(0) }
    }
}

impl<T: Real> Encoder<T> {
    /// Reads the weights of a valid configuration.
    pub fn new(config: &EncoderConfig, weights: &impl Weights<T>) -> Self {
        let linear = Linear::named("encoder.linear", weights);
        let [weight, bias] = ["weight", "bias"].map(|part| format!("encoder.norm.{part}"));
        let norm = config.layer_norm().then(|| Norm { weight: weights.get(&weight), bias: weights.get(&bias) });
        match config {
            EncoderConfig::Image(config) => {
                let (body, channels) = Body::image(config, weights);
                // The features lie with their channels last; the weights are turned rather than them.
                let positions = linear.inputs / channels;
                let turned = turn(linear.weight(), channels, positions);
                Self { body, linear: Linear::new(turned, linear.bias().to_vec()), norm }
            }
            EncoderConfig::Position(config) => Self { body: Body::position(config, weights), linear, norm },
        }
    }

    /// Embeds images of 84 x 84 or positions, whichever it takes, as `[Z]` each.
    pub fn encode(&self, inputs: &[Observed<'_>], room: &mut Room<T>) -> Vec<Vec<T>> {
        room.features.clear();
        for input in inputs {
            self.body.features(*input, room);
            room.features.extend_from_slice(&room.x);
        }
        let mut embeddings = vec![T::ZERO; inputs.len() * self.linear.outputs];
        self.linear.forward(&room.features, &mut embeddings);
        if let Some(norm) = &self.norm {
            embeddings.chunks_exact_mut(self.linear.outputs).for_each(|embedding| norm.apply(embedding));
        }
        embeddings.chunks_exact(self.linear.outputs).map(<[T]>::to_vec).collect()
    }
}

impl<T: Real> Body<T> {
    /// The convolutions, and the channels of the last one.
    fn image(config: &ImageEncoderConfig, weights: &impl Weights<T>) -> (Self, usize) {
        let (mut side, mut channels) = (SIZE as usize, CHANNELS as usize);
        let mut convolutions = Vec::new();
        for (i, conv) in config.convolutions.iter().enumerate() {
            let [weight, bias] = ["weight", "bias"].map(|part| weights.get(&format!("encoder.conv.{i}.{part}")));
            let (kernel, stride) = (conv.kernel as usize, conv.stride as usize);
            convolutions.push(Convolution::new((side, channels), (kernel, stride), &weight, bias));
            (side, channels) = ((side - kernel) / stride + 1, conv.channels as usize);
        }
        (Self::Image { convolutions }, channels)
    }

    fn position(config: &PositionEncoderConfig, weights: &impl Weights<T>) -> Self {
        let layer = |i| Linear::named(&format!("encoder.layer.{i}"), weights);
        Self::Position {
            centre_metres: config.centre_mm.map(|mm| mm as f64 / 1e3),
            scale_metres: T::from_f64(config.scale_mm as f64 / 1e3),
            layers: (0..config.layers.len()).map(layer).collect(),
        }
    }

    /// Leaves the features in `room.x`.
    fn features(&self, input: Observed<'_>, room: &mut Room<T>) {
        room.x.clear();
        match (self, input) {
            (Self::Image { convolutions }, Observed::Image(bytes)) => {
                room.x.resize(bytes.len(), T::ZERO);
                Arch::new().dispatch(Scale { bytes, x: &mut room.x });
                for convolution in convolutions {
                    convolution.forward(room);
                    std::mem::swap(&mut room.x, &mut room.y);
                }
            }
            (Self::Position { centre_metres, scale_metres, layers }, Observed::Position(metres)) => {
                for (at, centre) in metres.iter().zip(centre_metres) {
                    room.x.push(T::from_f64(f64::from(*at) - centre) / *scale_metres);
                }
                for layer in layers {
                    room.y.clear();
                    room.y.resize(layer.outputs, T::ZERO);
                    layer.forward(&room.x, &mut room.y);
                    rectify(&mut room.y);
                    std::mem::swap(&mut room.x, &mut room.y);
                }
            }
            _ => panic!("observations are checked as they arrive"),
        }
    }
}

impl<T: Real> Convolution<T> {
    /// Of S = `side` and C = `channels`, with `weight`, `[O, C, K, K]`, and `bias`, `[O]`.
    fn new((side, channels): (usize, usize), (kernel, stride): (usize, usize), weight: &[T], bias: Vec<T>) -> Self {
        let size = (side - kernel) / stride + 1;
        let starts = (0..size).flat_map(|top| (0..size).map(move |left| (top * side + left) * stride * channels));
        let places = (0..kernel).flat_map(|row| (0..kernel * channels).map(move |at| row * side * channels + at));
        Self {
            starts: starts.collect(),
            places: places.collect(),
            weight: Panels::transposed(&turn(weight, channels, kernel * kernel), kernel * kernel * channels),
            bias,
        }
    }

    /// `room.x`, `[S, S, C]`, to `room.y`, `[S', S', O]`.
    fn forward(&self, room: &mut Room<T>) {
        let Room { x, y, .. } = room;
        y.clear();
        self.starts.iter().for_each(|_| y.extend_from_slice(&self.bias));
        let patches = Left::Patches { image: x, starts: &self.starts, places: &self.places };
        multiply(true, y, patches, self.weight.matrix(0..self.bias.len()));
        rectify(y);
    }
}

/// Bytes as numbers from -1/2 to 1/2.
struct Scale<'a, T> {
    bytes: &'a [u8],
    x: &'a mut [T],
}

impl<T: Real> WithSimd for Scale<'_, T> {
    type Output = ();

    // Nothing here names a register; the compiler finds them, as wide as the dispatch says there are.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let (step, half) = (T::ONE / T::count(255), T::ONE / T::count(2));
        for (x, byte) in self.x.iter_mut().zip(self.bytes) {
            *x = T::from_u8(*byte) * step - half;
        }
    }
}

impl<T: Real> Norm<T> {
    fn apply(&self, x: &mut [T]) {
        let count = T::count(x.len());
        let mean = x.iter().copied().sum::<T>() / count;
        let variance = x.iter().map(|x| (*x - mean) * (*x - mean)).sum::<T>() / count;
        let scale = T::ONE / (variance + T::from_f64(EPSILON)).sqrt();
        for (x, (weight, bias)) in x.iter_mut().zip(self.weight.iter().zip(&self.bias)) {
            *x = (*x - mean) * scale * *weight + *bias;
        }
    }
}

/// Rows `[C, P]`, one after the other, as rows `[P, C]`.
fn turn<T: Real>(rows: &[T], channels: usize, positions: usize) -> Vec<T> {
    let row = |row: &[T]| {
        let at = (0..positions).flat_map(|p| (0..channels).map(move |c| c * positions + p));
        at.map(|at| row[at]).collect::<Vec<_>>()
    };
    rows.chunks_exact(channels * positions).flat_map(row).collect()
}
