//! The encoder f_φ, shared by observation and goal (figure "encoder", a).

use crate::config::{EncoderConfig, ImageEncoderConfig, PositionEncoderConfig};
use crate::{images, positions};
use serde::{Deserialize, Serialize};
use tch::nn::{self, Module};
use tch::{Kind, Tensor};

/// What images are embedded in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// As everywhere else.
    Float32,
    /// Where the processor has tiles for it (AMX), faster for many images at once, and close; elsewhere no faster, or far slower.
    Bfloat16,
}

impl Precision {
    /// The same, or float32 where the processor has no tiles for bfloat16.
    pub fn where_faster(self) -> Self {
        // AMX-BF16, which the standard library cannot name yet.
        #[cfg(target_arch = "x86_64")]
        let faster = std::arch::x86_64::__cpuid_count(7, 0).edx & (1 << 22) != 0;
        #[cfg(not(target_arch = "x86_64"))]
        let faster = false;
        if faster { self } else { Self::Float32 }
    }
}

/// What suits the input, then a linear layer to the embedding.
#[derive(Debug)]
pub struct Encoder {
    body: Body,
    linear: nn::Linear,
    layer_norm: Option<nn::LayerNorm>,
}

/// From the input to features, `[B, F]`.
#[derive(Debug)]
enum Body {
    Image { convolutions: Vec<Convolution> },
    Position { centre_metres: Tensor, scale_metres: f64, layers: Vec<nn::Linear> },
}

/// A convolution, and its stride in pixels, which the library keeps to itself.
#[derive(Debug)]
struct Convolution {
    layer: nn::Conv2D,
    stride: i64,
}

impl Encoder {
    /// Builds the encoder's variables under `path`. The configuration must be valid.
    pub fn new(path: &nn::Path, config: &EncoderConfig) -> Self {
        let (body, features) = match config {
            EncoderConfig::Image(config) => Body::image(path, config),
            EncoderConfig::Position(config) => Body::position(path, config),
        };
        let latent = config.latent();
        let linear = nn::linear(path / "linear", features, latent, Default::default());
        let layer_norm = config.layer_norm().then(|| nn::layer_norm(path / "norm", vec![latent], Default::default()));
        Self { body, linear, layer_norm }
    }

    /// Embeds images, `[B, 84, 84, 3]` bytes, or positions, `[B, 3]` in metres, as `[B, Z]`.
    pub fn encode(&self, input: &Tensor) -> Tensor {
        self.normalise(self.linear.forward(&self.body.features(input, self.kind())))
    }

    /// The same for images, where convolutions and the linear layer multiply in bfloat16; weights in float32, sums and what comes
    /// after stay in it.
    pub fn encode_in_bfloat16(&self, images: &Tensor) -> Tensor {
        let Body::Image { convolutions } = &self.body else { panic!("an encoder of images") };
        let mut y = Tensor::new();
        for (i, Convolution { layer, stride }) in convolutions.iter().enumerate() {
            let bias = layer.bs.as_ref().expect("built with a bias");
            let (weight, bias, stride) = if i == 0 {
                // Whole numbers up to 255 are exact in bfloat16, so that the weights take on the scaling of the pixels:
                // w (p / 255 - 1/2) + b = (w / 255) p + (b - Σw / 2).
                let sums = layer.ws.sum_dim_intlist([1, 2, 3].as_slice(), false, None::<Kind>);
                let (blocks, weight, stride) = in_blocks(images, &(&layer.ws / 255.0), *stride);
                y = blocks;
                (weight, bias - sums / 2.0, stride)
            } else {
                (layer.ws.shallow_clone(), bias.shallow_clone(), *stride)
            };
            let weight = channels_last(&weight.to_kind(Kind::BFloat16));
            y = y.conv2d(&weight, Some(bias.to_kind(Kind::BFloat16)), [stride; 2], [0, 0], [1, 1], 1).relu_();
        }
        // The features lie with their channels last; the weights are turned rather than them.
        let (_, channels, size, _) = y.size4().expect("a batch of feature maps");
        let weight = self.linear.ws.view([-1, channels, size, size]).permute([0, 2, 3, 1]).flatten(1, -1);
        let features = y.permute([0, 2, 3, 1]).flatten(1, -1);
        let x = features.matmul(&weight.to_kind(Kind::BFloat16).tr()).to_kind(Kind::Float);
        self.normalise(x + self.linear.bs.as_ref().expect("built with a bias"))
    }

    fn normalise(&self, x: Tensor) -> Tensor {
        match &self.layer_norm {
            Some(norm) => norm.forward(&x),
            None => x,
        }
    }

    /// The kind of the weights: float, or double in gradient checks.
    pub fn kind(&self) -> Kind {
        self.linear.ws.kind()
    }
}

/// Images `[B, 84, 84, 3]` as bfloat16 `[B, C, S, S]`, for a convolution with weights `[O, C, K, K]`, and its stride.
///
/// With the stride of the paper's first convolution, and a kernel that its blocks cut evenly, these become channels: the
/// same sums as a convolution of stride 1 with many channels, which the library computes far faster than one with three.
fn in_blocks(images: &Tensor, weight: &Tensor, stride: i64) -> (Tensor, Tensor, i64) {
    let (outputs, channels, kernel, _) = weight.size4().expect("the weight of a convolution");
    if stride != images::BLOCK || kernel % stride != 0 {
        return (images.permute([0, 3, 1, 2]).to_kind(Kind::BFloat16), weight.shallow_clone(), stride);
    }
    let (count, side) = (kernel / stride, images::SIZE / stride);
    let weight = weight.view([outputs, channels, count, stride, count, stride]).permute([0, 3, 5, 1, 2, 4]);
    let blocks = images::blocks_in_bfloat16(images).view([-1, side, side, stride * stride * channels]);
    (blocks.permute([0, 3, 1, 2]), weight.reshape([outputs, -1, count, count]), 1)
}

/// Lays a tensor out with its channels last in memory, which is the order that the library's convolutions like best.
fn channels_last(tensor: &Tensor) -> Tensor {
    tensor.permute([0, 2, 3, 1]).contiguous().permute([0, 3, 1, 2])
}

impl Body {
    /// The convolutions, and F.
    fn image(path: &nn::Path, config: &ImageEncoderConfig) -> (Self, i64) {
        let mut channels = images::CHANNELS;
        let mut convolutions = Vec::new();
        for (i, conv) in config.convolutions.iter().enumerate() {
            let options = nn::ConvConfig { stride: conv.stride, ..Default::default() };
            let layer = nn::conv2d(path / "conv" / i, channels, conv.channels, conv.kernel, options);
            convolutions.push(Convolution { layer, stride: conv.stride });
            channels = conv.channels;
        }
        let size = config.output_size().expect("validated configuration");
        (Self::Image { convolutions }, channels * size * size)
    }

    /// The linear layers, and F.
    fn position(path: &nn::Path, config: &PositionEncoderConfig) -> (Self, i64) {
        let mut width = positions::SIZE;
        let mut layers = Vec::new();
        for (i, &outputs) in config.layers.iter().enumerate() {
            layers.push(nn::linear(path / "layer" / i, width, outputs, Default::default()));
            width = outputs;
        }
        let centre_metres = Tensor::from_slice(&config.centre_mm.map(|mm| mm as f64 / 1e3));
        (Self::Position { centre_metres, scale_metres: config.scale_mm as f64 / 1e3, layers }, width)
    }

    fn features(&self, input: &Tensor, kind: Kind) -> Tensor {
        match self {
            Self::Image { convolutions } => {
                let mut y = input.permute([0, 3, 1, 2]).to_kind(kind) / 255.0 - 0.5;
                for Convolution { layer, .. } in convolutions {
                    y = layer.forward(&y).relu();
                }
                y.flatten(1, -1)
            }
            Self::Position { centre_metres, scale_metres, layers } => {
                let mut y = (input - centre_metres).to_kind(kind) / *scale_metres;
                for layer in layers {
                    y = layer.forward(&y).relu();
                }
                y
            }
        }
    }
}
