//! The encoder f_φ.

use crate::config::{EncoderConfig, ImageEncoderConfig, PositionEncoderConfig};
use crate::encoder::Precision;
use crate::engine::layers::conv2d::{Conv2d, Conv2dWorkspace, transpose};
use crate::engine::layers::conv2d_params::Conv2dParams;
use crate::engine::layers::layer_norm::LayerNorm;
use crate::engine::layers::linear::{Linear, LinearGradient, Weights};
use crate::engine::layers::passes::Stacked;
use crate::engine::layers::projection::{Projection, ProjectionWorkspace};
use crate::engine::layers::relu::{relu, relu_mask};
use crate::engine::layers::winograd_transform::PADDING;
use crate::engine::simd::buffer::{AlignedVec, resize, zeros};
use crate::engine::simd::element::Element;
use crate::images::{BYTES, CHANNELS, SIZE};
use crate::method::Observed;
use pulp::{Arch, Simd, WithSimd};
use std::mem::swap;

/// Inputs that go through the layers at once: with more of them weights are read less often, with fewer what a layer leaves lies
/// nearer.
pub const INPUTS: usize = 8;

/// Layers that suit the input, then a linear layer to the embedding.
#[derive(Debug)]
pub struct Encoder<T: Element> {
    numbers: Numbers<T>,
    layers: Vec<Layer<T>>,
    /// Of the features, which have their channels first in the checkpoint and last here: the weights are turned rather than they.
    channels: usize,
    linear: Projection<T>,
    norm: Option<LayerNorm<T>>,
}

/// What becomes of an input.
#[derive(Debug)]
enum Numbers<T> {
    Pixels,
    Position { centre_metres: [f64; 3], scale_metres: T },
}

/// A layer, and the rectified linear unit behind it.
#[derive(Debug)]
enum Layer<T: Element> {
    Convolution(Conv2d<T>),
    Linear(Linear<T>),
}

/// What an outer loss changes by when the weights do.
#[derive(Debug)]
pub struct EncoderGradient<T> {
    layers: Vec<Vec<LinearGradient<T>>>,
    linear: LinearGradient<T>,
    norm: Option<LinearGradient<T>>,
}

/// What the forward pass over inputs leaves.
#[derive(Debug)]
pub struct Tape<T: Element> {
    /// For every [`INPUTS`] of them what each layer takes but the first, with [`PADDING`] numbers behind it.
    groups: Vec<Vec<AlignedVec<T>>>,
    /// What the first layer takes: soon made again, and four times as large as the bytes that it is made of.
    first: AlignedVec<T>,
    /// `[R, F]`.
    features: AlignedVec<T>,
    /// What is normalised, `[R, Z]`.
    x: Vec<T>,
    /// Room for the passes.
    convolution: Conv2dWorkspace<T>,
    linear: ProjectionWorkspace<T>,
    features_hat: AlignedVec<T>,
    /// x̂ of a layer, and of the one behind it.
    x_hat: AlignedVec<T>,
    y_hat: AlignedVec<T>,
}

impl<T: Element> Tape<T> {
    /// Empty.
    pub fn new() -> Self {
        Self {
            groups: Vec::new(),
            first: zeros(0),
            features: zeros(0),
            x: Vec::new(),
            convolution: Conv2dWorkspace::new(),
            linear: ProjectionWorkspace::new(),
            features_hat: zeros(0),
            x_hat: zeros(0),
            y_hat: zeros(0),
        }
    }
}

impl<T: Element> Encoder<T> {
    /// Reads the weights of a valid configuration. Images are multiplied in this precision, positions as they are: there is
    /// little to gemm, and a place needs more than 8 bits.
    pub fn new(config: &EncoderConfig, precision: Precision, weights: &impl Weights<T>) -> Self {
        let ((numbers, layers, channels), precision) = match config {
            EncoderConfig::Image(config) => (of_images(config, precision, weights), precision),
            EncoderConfig::Position(config) => (of_positions(config, weights), Precision::Float32),
        };
        let [weight, bias] = ["weight", "bias"].map(|part| weights.get(&format!("encoder.linear.{part}")));
        let weight = transpose(&weight, channels, weight.len() / bias.len() / channels);
        let linear = Projection::new(&weight, bias, precision);
        let norm = config.layer_norm().then(|| LayerNorm::named("encoder.norm", weights));
        Self { numbers, layers, channels, linear, norm }
    }

    /// Z.
    pub fn latent(&self) -> usize {
        self.linear.outputs
    }

    /// Embeds images of 84 x 84 or positions, whichever it takes, `[R, Z]`. What is embedded `for_adjoint` leaves a whole tape.
    pub fn forward(&self, inputs: &[Observed<'_>], for_adjoint: bool, tape: &mut Tape<T>) -> Vec<T> {
        let count = if for_adjoint { inputs.len().div_ceil(INPUTS) } else { 1 };
        if tape.groups.len() < count {
            tape.groups.resize_with(count, || vec![zeros(0); self.layers.len().saturating_sub(1)]);
        }
        let features = resize(&mut tape.features, inputs.len() * self.linear.inputs);
        let groups = inputs.chunks(INPUTS).zip(features.chunks_mut(INPUTS * self.linear.inputs));
        for (i, (inputs, features)) in groups.enumerate() {
            self.features(inputs, features, (&mut tape.first, &mut tape.groups[i % count]), &mut tape.convolution);
        }
        tape.x.resize(inputs.len() * self.latent(), T::ZERO);
        self.linear.forward(features, &mut tape.x, &mut tape.linear);
        match &self.norm {
            Some(norm) => norm.forward(&tape.x),
            None => tape.x.clone(),
        }
    }

    /// After a [`Self::forward`] of these inputs for it: adds to the gradient what a gradient in the embeddings gives, `[R, Z]`.
    pub fn adjoint(
        &self,
        inputs: &[Observed<'_>],
        mut hat: Vec<T>,
        gradient: &mut EncoderGradient<T>,
        tape: &mut Tape<T>,
    ) {
        let rows = inputs.len();
        if let (Some(norm), Some(gradient)) = (&self.norm, &mut gradient.norm) {
            norm.vjp(&tape.x, &mut hat, gradient);
        }
        let group = INPUTS * self.linear.inputs;
        let features = &tape.features[..rows * self.linear.inputs];
        let features_hat = resize(&mut tape.features_hat, features.len());
        self.linear.vjp(features, &hat, features_hat, &mut gradient.linear, &mut tape.linear);
        let (Some((first, layers)), Some((in_first, in_layers))) =
            (self.layers.split_first(), gradient.layers.split_first_mut())
        else {
            return;
        };
        let groups = inputs.chunks(INPUTS).zip(&tape.groups);
        for ((inputs, xs), (mut y, y_hat)) in groups.zip(features.chunks(group).zip(features_hat.chunks(group))) {
            let rows = inputs.len();
            resize(&mut tape.y_hat, y_hat.len()).copy_from_slice(y_hat);
            for ((layer, x), gradient) in layers.iter().zip(xs).zip(&mut *in_layers).rev() {
                let y_hat = &mut tape.y_hat[..y.len()];
                relu_mask(y_hat, y);
                let x_hat = resize(&mut tape.x_hat, rows * layer.inputs());
                layer.adjoint((rows, x, y_hat), Some(x_hat), gradient, &mut tape.convolution);
                swap(&mut tape.x_hat, &mut tape.y_hat);
                y = &x[..rows * layer.inputs()];
            }
            let y_hat = &mut tape.y_hat[..y.len()];
            relu_mask(y_hat, y);
            let x = self.entering(inputs, &mut tape.first);
            first.adjoint((rows, x, y_hat), None, in_first, &mut tape.convolution);
        }
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> EncoderGradient<T> {
        EncoderGradient {
            layers: self.layers.iter().map(Layer::gradient).collect(),
            linear: self.linear.gradient(),
            norm: self.norm.as_ref().map(LayerNorm::gradient),
        }
    }

    /// A gradient by the names of the weights.
    pub fn in_weights(&self, gradient: &EncoderGradient<T>) -> Vec<(String, Vec<T>)> {
        let mut weights = Vec::new();
        let mut add = |name: String, [weight, bias]: [Vec<T>; 2]| {
            weights.push((format!("encoder.{name}.weight"), weight));
            weights.push((format!("encoder.{name}.bias"), bias));
        };
        for (i, (layer, gradient)) in self.layers.iter().zip(&gradient.layers).enumerate() {
            match layer {
                Layer::Convolution(convolution) => add(format!("conv.{i}"), convolution.in_weights(gradient)),
                Layer::Linear(_) => add(format!("layer.{i}"), [gradient[0].weight.to_vec(), gradient[0].bias.to_vec()]),
            }
        }
        let LinearGradient { weight, bias } = &gradient.linear;
        add("linear".to_owned(), [transpose(weight, self.linear.inputs / self.channels, self.channels), bias.to_vec()]);
        if let Some(LinearGradient { weight, bias }) = &gradient.norm {
            add("norm".to_owned(), [weight.to_vec(), bias.to_vec()]);
        }
        weights
    }

    /// Through the layers, to `[R, F]`.
    fn features(
        &self,
        inputs: &[Observed<'_>],
        features: &mut [T],
        (first, between): (&mut AlignedVec<T>, &mut [AlignedVec<T>]),
        room: &mut Conv2dWorkspace<T>,
    ) {
        let Some((last, layers)) = self.layers.split_last() else { return self.numbers.write(inputs, features) };
        let mut x = self.entering(inputs, first);
        for (layer, y) in layers.iter().zip(between) {
            let size = inputs.len() * layer.outputs();
            let y = resize(y, size + PADDING);
            layer.forward(inputs.len(), x, &mut y[..size], room);
            x = y;
        }
        last.forward(inputs.len(), x, features, room);
    }

    /// What the first layer takes, with [`PADDING`] numbers behind it.
    fn entering<'a>(&self, inputs: &[Observed<'_>], x: &'a mut AlignedVec<T>) -> &'a [T] {
        let x = resize(x, inputs.len() * self.layers[0].inputs() + PADDING);
        self.numbers.write(inputs, x);
        x
    }
}

impl<T: Element> EncoderGradient<T> {
    /// Adds that of other inputs.
    pub fn add(&mut self, other: &Self) {
        let ours = self.layers.iter_mut().flatten().chain([&mut self.linear]).chain(&mut self.norm);
        let others = other.layers.iter().flatten().chain([&other.linear]).chain(&other.norm);
        ours.zip(others).for_each(|(ours, other)| ours.add(other));
    }
}

/// The convolutions, with the channels of the last one.
fn of_images<T: Element>(
    config: &ImageEncoderConfig,
    precision: Precision,
    weights: &impl Weights<T>,
) -> (Numbers<T>, Vec<Layer<T>>, usize) {
    let (mut side, mut channels) = (SIZE as usize, CHANNELS as usize);
    let mut layers = Vec::new();
    for (i, conv) in config.convolutions.iter().enumerate() {
        let [weight, bias] = ["weight", "bias"].map(|part| weights.get(&format!("encoder.conv.{i}.{part}")));
        let (kernel, stride) = (conv.kernel as usize, conv.stride as usize);
        layers.push(Layer::Convolution(Conv2d::new(
            Conv2dParams { side, channels, kernel, stride },
            &weight,
            &bias,
            precision,
        )));
        (side, channels) = ((side - kernel) / stride + 1, conv.channels as usize);
    }
    (Numbers::Pixels, layers, channels)
}

/// The layers before the last; their features have no positions.
fn of_positions<T: Element>(
    config: &PositionEncoderConfig,
    weights: &impl Weights<T>,
) -> (Numbers<T>, Vec<Layer<T>>, usize) {
    let numbers = Numbers::Position {
        centre_metres: config.centre_mm.map(|mm| mm as f64 / 1e3),
        scale_metres: T::from_f64(config.scale_mm as f64 / 1e3),
    };
    let layer = |i| Layer::Linear(Linear::named(&format!("encoder.layer.{i}"), weights));
    (numbers, (0..config.layers.len()).map(layer).collect(), 1)
}

impl<T: Element> Layer<T> {
    fn inputs(&self) -> usize {
        match self {
            Self::Convolution(convolution) => convolution.inputs,
            Self::Linear(linear) => linear.inputs,
        }
    }

    fn outputs(&self) -> usize {
        match self {
            Self::Convolution(convolution) => convolution.outputs,
            Self::Linear(linear) => linear.outputs,
        }
    }

    fn gradient(&self) -> Vec<LinearGradient<T>> {
        match self {
            Self::Convolution(convolution) => convolution.gradient(),
            Self::Linear(linear) => vec![linear.gradient()],
        }
    }

    /// Of R = `rows` inputs.
    fn forward(&self, rows: usize, x: &[T], y: &mut [T], room: &mut Conv2dWorkspace<T>) {
        match self {
            Self::Convolution(convolution) => convolution.forward(x, y, room),
            Self::Linear(linear) => {
                linear.forward(&x[..rows * linear.inputs], y);
                relu(y);
            }
        }
    }

    /// Adds to the gradient what ŷ gives, which is a gradient in what the unit takes, and writes x̂ if it is asked for.
    fn adjoint(
        &self,
        (rows, x, y_hat): (usize, &[T], &[T]),
        x_hat: Option<&mut [T]>,
        gradient: &mut [LinearGradient<T>],
        room: &mut Conv2dWorkspace<T>,
    ) {
        match self {
            Self::Convolution(convolution) => convolution.vjp(x, y_hat, x_hat, gradient, room),
            Self::Linear(linear) => {
                let stacked = Stacked { x: &x[..rows * linear.inputs], y: y_hat };
                linear.accumulate_all(rows, stacked, &mut gradient[0]);
                if let Some(x_hat) = x_hat {
                    linear.vjp(y_hat, x_hat);
                }
            }
        }
    }
}

impl<T: Element> Numbers<T> {
    fn write(&self, inputs: &[Observed<'_>], x: &mut [T]) {
        match self {
            Self::Pixels => {
                for (x, input) in x.chunks_exact_mut(BYTES).zip(inputs) {
                    let Observed::Image(bytes) = input else { panic!("observations are checked as they arrive") };
                    Arch::new().dispatch(Scale { bytes, x });
                }
            }
            Self::Position { centre_metres, scale_metres } => {
                for (x, input) in x.chunks_exact_mut(centre_metres.len()).zip(inputs) {
                    let Observed::Position(metres) = input else { panic!("observations are checked as they arrive") };
                    for (x, (at, centre)) in x.iter_mut().zip(metres.iter().zip(centre_metres)) {
                        *x = T::from_f64(f64::from(*at) - centre) / *scale_metres;
                    }
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

impl<T: Element> WithSimd for Scale<'_, T> {
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
