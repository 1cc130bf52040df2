//! Encoder f_φ, shared by observation and goal (figure "encoder", a).

use cpn::config::{EncoderConfig, ImageEncoderConfig, PositionEncoderConfig};
use cpn::{images, positions};
use tch::nn::{self, Module};
use tch::{Kind, Tensor};

/// The encoder: convolutions or linear layers by the kind of input, a linear layer to the embedding, and layer normalisation.
#[derive(Debug)]
pub struct Encoder {
    body: Body,
    linear: nn::Linear,
    layer_norm: Option<nn::LayerNorm>,
}

/// Layers from the input to features, `[B, F]`.
#[derive(Debug)]
enum Body {
    Image { convolutions: Vec<nn::Conv2D> },
    Position { centre_metres: Tensor, scale_metres: f64, layers: Vec<nn::Linear> },
}

impl Encoder {
    /// Builds the variables under `path`, of a valid configuration.
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

    /// Embeddings, `[B, Z]`, of images, `[B, 84, 84, 3]` bytes, or positions, `[B, 3]` in metres.
    pub fn encode(&self, input: &Tensor) -> Tensor {
        self.normalise(self.linear.forward(&self.body.features(input, self.kind())))
    }

    fn normalise(&self, x: Tensor) -> Tensor {
        match &self.layer_norm {
            Some(norm) => norm.forward(&x),
            None => x,
        }
    }

    /// Kind of the weights: float, or double in gradient checks.
    pub fn kind(&self) -> Kind {
        self.linear.ws.kind()
    }
}

impl Body {
    /// The convolutions; returns them with F.
    fn image(path: &nn::Path, config: &ImageEncoderConfig) -> (Self, i64) {
        let mut channels = images::CHANNELS;
        let mut convolutions = Vec::new();
        for (i, conv) in config.convolutions.iter().enumerate() {
            let options = nn::ConvConfig { stride: conv.stride, ..Default::default() };
            convolutions.push(nn::conv2d(path / "conv" / i, channels, conv.channels, conv.kernel, options));
            channels = conv.channels;
        }
        let size = config.output_size().expect("validated configuration");
        (Self::Image { convolutions }, channels * size * size)
    }

    /// The linear layers; returns them with F.
    fn position(path: &nn::Path, config: &PositionEncoderConfig) -> (Self, i64) {
        let mut width = positions::SIZE;
        let mut layers = Vec::new();
        for (i, &outputs) in config.layers.iter().enumerate() {
            layers.push(nn::linear(path / "layer" / i, width, outputs, Default::default()));
            width = outputs;
        }
        let centre_metres = Tensor::from_slice(&config.centre_mm.map(|mm| mm as f64 / 1e3)).to_device(path.device());
        (Self::Position { centre_metres, scale_metres: config.scale_mm as f64 / 1e3, layers }, width)
    }

    fn features(&self, input: &Tensor, kind: Kind) -> Tensor {
        match self {
            Self::Image { convolutions } => {
                let mut y = input.permute([0, 3, 1, 2]).to_kind(kind) / 255.0 - 0.5;
                for layer in convolutions {
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
