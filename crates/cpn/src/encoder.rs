//! The image encoder f_φ, shared by observation and goal (figure "encoder", a).

use crate::config::EncoderConfig;
use crate::images;
use tch::nn::{self, Module};
use tch::{Kind, Tensor};

/// Convolutions, then a linear layer to the embedding.
#[derive(Debug)]
pub struct Encoder {
    convolutions: Vec<nn::Conv2D>,
    linear: nn::Linear,
    layer_norm: Option<nn::LayerNorm>,
}

impl Encoder {
    /// Builds the encoder's variables under `path`. The configuration must be valid.
    pub fn new(path: &nn::Path, config: &EncoderConfig) -> Self {
        let mut channels = images::CHANNELS;
        let mut convolutions = Vec::new();
        for (i, conv) in config.convolutions.iter().enumerate() {
            let options = nn::ConvConfig { stride: conv.stride, ..Default::default() };
            convolutions.push(nn::conv2d(path / "conv" / i, channels, conv.channels, conv.kernel, options));
            channels = conv.channels;
        }
        let size = config.output_size().expect("validated configuration");
        let linear = nn::linear(path / "linear", channels * size * size, config.latent, Default::default());
        let layer_norm =
            config.layer_norm.then(|| nn::layer_norm(path / "norm", vec![config.latent], Default::default()));
        Self { convolutions, linear, layer_norm }
    }

    /// Embeds images: `[B, 84, 84, 3]` bytes to `[B, Z]`.
    pub fn encode(&self, images: &Tensor) -> Tensor {
        let kind = self.linear.ws.kind();
        let mut y = images.permute([0, 3, 1, 2]).to_kind(kind) / 255.0 - 0.5;
        for conv in &self.convolutions {
            y = conv.forward(&y).relu();
        }
        let x = self.linear.forward(&y.flatten(1, -1));
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
