//! Encoder f_φ, with its forward pass and its first-order backward pass.

use crate::config::{EncoderConfig, ImageEncoderConfig, PositionEncoderConfig};
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
use crate::observation::Observed;
use crate::precision::Precision;
use pulp::{Arch, Simd, WithSimd};
use std::mem::swap;

/// Number of inputs that pass the layers together: more read the weights less often, and fewer keep a layer's outputs in nearer
/// caches.
pub const GROUP: usize = 8;

/// The encoder: convolutions or linear layers by the kind of input, a projection to the embedding, and layer normalisation.
#[derive(Debug)]
pub struct Encoder<T: Element> {
    scaling: InputScaling<T>,
    layers: Vec<EncoderLayer<T>>,
    /// Channels of the features: first in the checkpoint's layout and last here, so that the projection's weights are transposed
    /// rather than the features.
    channels: usize,
    projection: Projection<T>,
    norm: Option<LayerNorm<T>>,
}

/// Scaling of an input for the first layer.
#[derive(Debug)]
enum InputScaling<T> {
    Pixels,
    Position { centre_metres: [f64; 3], scale_metres: T },
}

/// A layer, followed by a rectified linear unit.
#[derive(Debug)]
enum EncoderLayer<T: Element> {
    Conv2d(Conv2d<T>),
    Linear(Linear<T>),
}

/// Gradient of an outer loss in the weights.
#[derive(Debug)]
pub struct EncoderGradient<T> {
    layers: Vec<Vec<LinearGradient<T>>>,
    projection: LinearGradient<T>,
    norm: Option<LinearGradient<T>>,
}

/// Tape of the encoder: activations of the forward pass, and workspaces.
#[derive(Debug)]
pub struct EncoderTape<T: Element> {
    /// Activations before each layer but the first, followed by [`PADDING`], for each [`GROUP`] inputs.
    groups: Vec<Vec<AlignedVec<T>>>,
    /// Scaled inputs of the first layer. Not kept: they are fast to recompute, and four times as large as an image's bytes.
    first: AlignedVec<T>,
    /// `[R, F]`.
    features: AlignedVec<T>,
    /// The projection before normalisation, `[R, Z]`.
    x: Vec<T>,
    conv2d: Conv2dWorkspace<T>,
    projection: ProjectionWorkspace<T>,
    features_hat: AlignedVec<T>,
    /// x̂ of a layer, and ŷ, which is x̂ of the next layer.
    x_hat: AlignedVec<T>,
    y_hat: AlignedVec<T>,
}

impl<T: Element> EncoderTape<T> {
    /// An empty tape, which grows on use.
    pub fn new() -> Self {
        Self {
            groups: Vec::new(),
            first: zeros(0),
            features: zeros(0),
            x: Vec::new(),
            conv2d: Conv2dWorkspace::new(),
            projection: ProjectionWorkspace::new(),
            features_hat: zeros(0),
            x_hat: zeros(0),
            y_hat: zeros(0),
        }
    }
}

impl<T: Element> Encoder<T> {
    /// The encoder of a valid configuration. `precision` applies to images; positions are always encoded in float32, since their
    /// layers are small, and 8 bits are too coarse for coordinates.
    pub fn new(config: &EncoderConfig, precision: Precision, weights: &impl Weights<T>) -> Self {
        let (Body { scaling, layers, channels }, precision) = match config {
            EncoderConfig::Image(config) => (Body::image(config, precision, weights), precision),
            EncoderConfig::Position(config) => (Body::position(config, weights), Precision::Float32),
        };
        let [weight, bias] = ["weight", "bias"].map(|part| weights.get(&format!("encoder.linear.{part}")));
        let weight = transpose(&weight, channels, weight.len() / bias.len() / channels);
        let projection = Projection::new(&weight, bias, precision);
        let norm = config.layer_norm().then(|| LayerNorm::named("encoder.norm", weights));
        Self { scaling, layers, channels, projection, norm }
    }

    /// Z, the size of an embedding.
    pub fn latent(&self) -> usize {
        self.projection.outputs
    }

    /// Embeddings `[R, Z]` of images of 84 x 84 or of positions, by the configuration. [`Self::vjp`] needs the activations of all
    /// inputs, `keep_tape`.
    pub fn forward(&self, inputs: &[Observed<'_>], keep_tape: bool, tape: &mut EncoderTape<T>) -> Vec<T> {
        let count = if keep_tape { inputs.len().div_ceil(GROUP) } else { 1 };
        if tape.groups.len() < count {
            tape.groups.resize_with(count, || vec![zeros(0); self.layers.len().saturating_sub(1)]);
        }

        // The layers, group by group.
        let features = resize(&mut tape.features, inputs.len() * self.projection.inputs);
        let groups = inputs.chunks(GROUP).zip(features.chunks_mut(GROUP * self.projection.inputs));
        for (i, (inputs, features)) in groups.enumerate() {
            self.features(inputs, features, &mut tape.first, &mut tape.groups[i % count], &mut tape.conv2d);
        }

        // The projection.
        tape.x.resize(inputs.len() * self.latent(), T::ZERO);
        self.projection.forward(features, &mut tape.x, &mut tape.projection);
        match &self.norm {
            Some(norm) => norm.forward(&tape.x),
            None => tape.x.clone(),
        }
    }

    /// First-order backward pass from the gradient in the embeddings, `hat`, `[R, Z]`, after [`Self::forward`] of the same inputs
    /// with `keep_tape`: adds to the weights' gradient.
    pub fn vjp(
        &self,
        inputs: &[Observed<'_>],
        mut hat: Vec<T>,
        gradient: &mut EncoderGradient<T>,
        tape: &mut EncoderTape<T>,
    ) {
        let rows = inputs.len();
        if let (Some(norm), Some(gradient)) = (&self.norm, &mut gradient.norm) {
            norm.vjp(&tape.x, &mut hat, gradient);
        }

        // The projection.
        let group = GROUP * self.projection.inputs;
        let features = &tape.features[..rows * self.projection.inputs];
        let features_hat = resize(&mut tape.features_hat, features.len());
        self.projection.vjp(features, &hat, features_hat, &mut gradient.projection, &mut tape.projection);

        // The layers in reverse, group by group; the first has no gradient in its inputs.
        let (Some((first, layers)), Some((in_first, in_layers))) =
            (self.layers.split_first(), gradient.layers.split_first_mut())
        else {
            return;
        };
        let groups = inputs.chunks(GROUP).zip(&tape.groups);
        for ((inputs, xs), (mut y, y_hat)) in groups.zip(features.chunks(group).zip(features_hat.chunks(group))) {
            let rows = inputs.len();
            resize(&mut tape.y_hat, y_hat.len()).copy_from_slice(y_hat);
            for ((layer, x), gradient) in layers.iter().zip(xs).zip(&mut *in_layers).rev() {
                let y_hat = &mut tape.y_hat[..y.len()];
                relu_mask(y_hat, y);
                let x_hat = resize(&mut tape.x_hat, rows * layer.inputs());
                layer.vjp(rows, x, y_hat, Some(x_hat), gradient, &mut tape.conv2d);
                swap(&mut tape.x_hat, &mut tape.y_hat);
                y = &x[..rows * layer.inputs()];
            }
            let y_hat = &mut tape.y_hat[..y.len()];
            relu_mask(y_hat, y);
            let x = self.scaled(inputs, &mut tape.first);
            first.vjp(rows, x, y_hat, None, in_first, &mut tape.conv2d);
        }
    }

    /// A zero gradient.
    pub fn gradient(&self) -> EncoderGradient<T> {
        EncoderGradient {
            layers: self.layers.iter().map(EncoderLayer::gradient).collect(),
            projection: self.projection.gradient(),
            norm: self.norm.as_ref().map(LayerNorm::gradient),
        }
    }

    /// A gradient by the weights' names in a checkpoint.
    pub fn in_weights(&self, gradient: &EncoderGradient<T>) -> Vec<(String, Vec<T>)> {
        let mut weights = Vec::new();
        let mut add = |name: String, [weight, bias]: [Vec<T>; 2]| {
            weights.push((format!("encoder.{name}.weight"), weight));
            weights.push((format!("encoder.{name}.bias"), bias));
        };

        for (i, (layer, gradient)) in self.layers.iter().zip(&gradient.layers).enumerate() {
            match layer {
                EncoderLayer::Conv2d(conv2d) => add(format!("conv.{i}"), conv2d.in_weights(gradient)),
                EncoderLayer::Linear(_) => {
                    add(format!("layer.{i}"), [gradient[0].weight.to_vec(), gradient[0].bias.to_vec()])
                }
            }
        }

        let LinearGradient { weight, bias } = &gradient.projection;
        let positions = self.projection.inputs / self.channels;
        add("linear".to_owned(), [transpose(weight, positions, self.channels), bias.to_vec()]);
        if let Some(LinearGradient { weight, bias }) = &gradient.norm {
            add("norm".to_owned(), [weight.to_vec(), bias.to_vec()]);
        }
        weights
    }

    /// Features `[R, F]`; `between` receives the activations before each layer but the first.
    fn features(
        &self,
        inputs: &[Observed<'_>],
        features: &mut [T],
        first: &mut AlignedVec<T>,
        between: &mut [AlignedVec<T>],
        workspace: &mut Conv2dWorkspace<T>,
    ) {
        let Some((last, layers)) = self.layers.split_last() else { return self.scaling.write(inputs, features) };
        let mut x = self.scaled(inputs, first);
        for (layer, y) in layers.iter().zip(between) {
            let size = inputs.len() * layer.outputs();
            let y = resize(y, size + PADDING);
            layer.forward(inputs.len(), x, &mut y[..size], workspace);
            x = y;
        }
        last.forward(inputs.len(), x, features, workspace);
    }

    /// Scaled inputs of the first layer, followed by [`PADDING`].
    fn scaled<'a>(&self, inputs: &[Observed<'_>], x: &'a mut AlignedVec<T>) -> &'a [T] {
        let x = resize(x, inputs.len() * self.layers[0].inputs() + PADDING);
        self.scaling.write(inputs, x);
        x
    }
}

impl<T: Element> EncoderGradient<T> {
    /// `self += other`.
    pub fn add(&mut self, other: &Self) {
        let ours = self.layers.iter_mut().flatten().chain([&mut self.projection]).chain(&mut self.norm);
        let others = other.layers.iter().flatten().chain([&other.projection]).chain(&other.norm);
        ours.zip(others).for_each(|(ours, other)| ours.add(other));
    }
}

/// The scaling and the layers before the projection, with the channels of the features.
struct Body<T: Element> {
    scaling: InputScaling<T>,
    layers: Vec<EncoderLayer<T>>,
    channels: usize,
}

impl<T: Element> Body<T> {
    /// The convolutions.
    fn image(config: &ImageEncoderConfig, precision: Precision, weights: &impl Weights<T>) -> Self {
        let (mut side, mut channels) = (SIZE as usize, CHANNELS as usize);
        let mut layers = Vec::new();
        for (i, conv) in config.convolutions.iter().enumerate() {
            let [weight, bias] = ["weight", "bias"].map(|part| weights.get(&format!("encoder.conv.{i}.{part}")));
            let params = Conv2dParams { side, channels, kernel: conv.kernel as usize, stride: conv.stride as usize };
            layers.push(EncoderLayer::Conv2d(Conv2d::new(params, &weight, &bias, precision)));
            (side, channels) = (params.output_side(), conv.channels as usize);
        }
        Self { scaling: InputScaling::Pixels, layers, channels }
    }

    /// The linear layers; their features are channels at a single position.
    fn position(config: &PositionEncoderConfig, weights: &impl Weights<T>) -> Self {
        let scaling = InputScaling::Position {
            centre_metres: config.centre_mm.map(|mm| mm as f64 / 1e3),
            scale_metres: T::from_f64(config.scale_mm as f64 / 1e3),
        };
        let layer = |i| EncoderLayer::Linear(Linear::named(&format!("encoder.layer.{i}"), weights));
        Self { scaling, layers: (0..config.layers.len()).map(layer).collect(), channels: 1 }
    }
}

impl<T: Element> EncoderLayer<T> {
    fn inputs(&self) -> usize {
        match self {
            Self::Conv2d(conv2d) => conv2d.inputs,
            Self::Linear(linear) => linear.inputs,
        }
    }

    fn outputs(&self) -> usize {
        match self {
            Self::Conv2d(conv2d) => conv2d.outputs,
            Self::Linear(linear) => linear.outputs,
        }
    }

    fn gradient(&self) -> Vec<LinearGradient<T>> {
        match self {
            Self::Conv2d(conv2d) => conv2d.gradient(),
            Self::Linear(linear) => vec![linear.gradient()],
        }
    }

    /// y of x, for R = `rows` inputs, after the rectified linear unit.
    fn forward(&self, rows: usize, x: &[T], y: &mut [T], workspace: &mut Conv2dWorkspace<T>) {
        match self {
            Self::Conv2d(conv2d) => conv2d.forward(x, y, workspace),
            Self::Linear(linear) => {
                linear.forward(&x[..rows * linear.inputs], y);
                relu(y);
            }
        }
    }

    /// First-order backward pass from ŷ, the gradient before the rectified linear unit: adds to the weights' gradient, and writes
    /// x̂ if given.
    fn vjp(
        &self,
        rows: usize,
        x: &[T],
        y_hat: &[T],
        x_hat: Option<&mut [T]>,
        gradient: &mut [LinearGradient<T>],
        workspace: &mut Conv2dWorkspace<T>,
    ) {
        match self {
            Self::Conv2d(conv2d) => conv2d.vjp(x, y_hat, x_hat, gradient, workspace),
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

impl<T: Element> InputScaling<T> {
    /// Writes the scaled inputs, `[R, inputs of the first layer]`.
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

/// Scaling of bytes to [-1/2, 1/2].
struct Scale<'a, T> {
    bytes: &'a [u8],
    x: &'a mut [T],
}

impl<T: Element> WithSimd for Scale<'_, T> {
    type Output = ();

    // The compiler vectorises the loop for the instructions of the dispatch.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        let (step, half) = (T::ONE / T::count(255), T::ONE / T::count(2));
        for (x, byte) in self.x.iter_mut().zip(self.bytes) {
            *x = T::from_u8(*byte) * step - half;
        }
    }
}
