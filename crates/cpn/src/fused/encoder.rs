//! The encoder f_φ for planning.

use super::convolution::{self, Convolution, turn};
use super::gate::rectify;
use super::lanes::{Aligned, grown, zeros};
use super::linear::{Linear, Weights};
use super::real::Real;
use super::winograd::BEYOND;
use crate::config::{EncoderConfig, ImageEncoderConfig, PositionEncoderConfig};
use crate::images::{BYTES, CHANNELS, SIZE};
use crate::method::Observed;
use pulp::{Arch, Simd, WithSimd};

/// What layer normalisation adds to the variance, as libtorch does.
const EPSILON: f64 = 1e-5;
/// Inputs that go through the layers at once: with more of them weights are read less often, with fewer what a layer leaves lies
/// nearer.
const INPUTS: usize = 4;

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

/// Layer normalisation, `[Z]`.
#[derive(Debug)]
struct Norm<T> {
    weight: Vec<T>,
    bias: Vec<T>,
}

/// Room for the passes, kept from input to input.
#[derive(Debug)]
pub struct Room<T> {
    /// What a layer takes, with some numbers behind it.
    x: Aligned<T>,
    /// What it gives.
    y: Aligned<T>,
    convolution: convolution::Room<T>,
    /// Of all inputs, `[R, F]`.
    features: Aligned<T>,
}

impl<T: Real> Room<T> {
    /// Empty.
    pub fn new() -> Self {
        Self { x: zeros(0), y: zeros(0), convolution: convolution::Room::new(), features: zeros(0) }
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
        for inputs in inputs.chunks(INPUTS) {
            self.body.features(inputs, room);
            room.features.extend_from_slice(&room.x[..inputs.len() * self.linear.inputs]);
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
            convolutions.push(Convolution::new((side, channels), (kernel, stride), &weight, &bias));
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

    /// Leaves the features, `[R, F]`, at the beginning of `room.x`.
    fn features(&self, inputs: &[Observed<'_>], room: &mut Room<T>) {
        let Room { x, y, convolution, .. } = room;
        match self {
            Self::Image { convolutions } => {
                let numbers = grown(x, inputs.len() * BYTES + BEYOND);
                for (x, input) in numbers.chunks_exact_mut(BYTES).zip(inputs) {
                    let Observed::Image(bytes) = input else { panic!("observations are checked as they arrive") };
                    Arch::new().dispatch(Scale { bytes, x });
                }
                for layer in convolutions {
                    let size = inputs.len() * layer.outputs;
                    layer.forward(x, &mut grown(y, size + BEYOND)[..size], convolution);
                    std::mem::swap(x, y);
                }
            }
            Self::Position { centre_metres, scale_metres, layers } => {
                let numbers = grown(x, inputs.len() * centre_metres.len());
                for (x, input) in numbers.chunks_exact_mut(centre_metres.len()).zip(inputs) {
                    let Observed::Position(metres) = input else { panic!("observations are checked as they arrive") };
                    for (x, (at, centre)) in x.iter_mut().zip(metres.iter().zip(centre_metres)) {
                        *x = T::from_f64(f64::from(*at) - centre) / *scale_metres;
                    }
                }
                for layer in layers {
                    let features = grown(y, inputs.len() * layer.outputs);
                    layer.forward(&x[..inputs.len() * layer.inputs], features);
                    rectify(features);
                    std::mem::swap(x, y);
                }
            }
        }
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
