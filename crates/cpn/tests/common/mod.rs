//! Small models and batches for tests.

#![allow(dead_code, reason = "each test file uses its part")]

use cpn::config::{ConvConfig, ImageEncoderConfig, PositionEncoderConfig};
use cpn::loss::Batch;
use cpn::{Agent, EncoderConfig, Frames, MethodKind, ModelConfig, images};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::{Device, Kind, Tensor};

/// A model with few weights.
pub fn small_config(method: MethodKind) -> ModelConfig {
    let encoder = EncoderConfig::Image(ImageEncoderConfig {
        convolutions: vec![
            ConvConfig { channels: 3, kernel: 8, stride: 8 },
            ConvConfig { channels: 4, kernel: 4, stride: 3 },
        ],
        latent: 6,
        layer_norm: true,
    });
    ModelConfig { encoder, hidden: 5, gate_hidden: 4, ..ModelConfig::paper(method) }
}

/// The same model for positions in a box of 2 m.
pub fn position_config(method: MethodKind) -> ModelConfig {
    let (centre_mm, scale_mm, layers) = ([500, 0, -200], 400, vec![7, 5]);
    let encoder = PositionEncoderConfig { centre_mm, scale_mm, layers, latent: 6, layer_norm: true };
    ModelConfig { encoder: EncoderConfig::Position(encoder), actions: 3, ..small_config(method) }
}

/// An agent in float64, so that gradients can be told from rounding.
pub fn double_agent(config: ModelConfig) -> Agent {
    let mut agent = Agent::new(config, 3);
    agent.variables_mut().double();
    agent
}

/// Images of noise, `[B, 84, 84, 3]`.
pub fn noise_images(batch: i64, seed: u64) -> Tensor {
    let mut data = vec![0; batch as usize * images::BYTES];
    ChaCha8Rng::seed_from_u64(seed).fill(data.as_mut_slice());
    images::from_bytes(&data).unwrap()
}

/// Values in [-1, 1), float64.
pub fn uniform(shape: &[i64], seed: u64) -> Tensor {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let values: Vec<f64> = (0..shape.iter().product()).map(|_| rng.random_range(-1.0..1.0)).collect();
    Tensor::from_slice(&values).view(shape)
}

/// Images, or positions.
pub fn frames(tensor: &Tensor) -> Frames {
    match tensor.kind() {
        Kind::Uint8 => Frames::Images(Vec::try_from(tensor.flatten(0, -1)).unwrap()),
        _ => {
            let metres: Vec<f32> = Vec::try_from(tensor.to_kind(Kind::Float).flatten(0, -1)).unwrap();
            Frames::Positions(metres.as_chunks().0.to_vec())
        }
    }
}

/// A batch of observations, each with a goal of its own.
pub fn paired(observations: &Tensor, goals: &Tensor, actions: &Tensor, mask: &Tensor) -> Batch {
    let count = observations.size()[0];
    let rows = |first| Tensor::arange_start(first, first + count, (Kind::Int64, Device::Cpu));
    Batch {
        frames: frames(&Tensor::cat(&[observations, goals], 0)),
        observations: rows(0),
        goals: rows(count),
        actions: actions.shallow_clone(),
        mask: mask.shallow_clone(),
    }
}

/// Features of the largest of these encoders; over more, float32's linear layer alone rounds by more than 1e-5.
const FEATURES: i64 = 8192;

/// Encoders of one or two convolutions: kernels of one to four strides, or of a pixel more; images that end with a tile, or not.
pub fn encoders() -> impl Strategy<Value = ImageEncoderConfig> {
    let taps = (1i64..5, 1i64..5, 0i64..2).prop_map(|(taps, stride, more)| (taps * stride + more, stride));
    let convolution = (prop_oneof![Just(16i64), Just(32), Just(5)], taps)
        .prop_filter("a valid kernel", |(_, (kernel, _))| *kernel <= 8)
        .prop_map(|(channels, (kernel, stride))| ConvConfig { channels, kernel, stride });
    (proptest::collection::vec(convolution, 1..3), any::<bool>())
        .prop_map(|(convolutions, layer_norm)| ImageEncoderConfig { convolutions, latent: 6, layer_norm })
        .prop_filter("few enough features", |encoder| {
            let side = encoder.convolutions.iter().fold(images::SIZE, |side, c| (side - c.kernel) / c.stride + 1);
            side * side * encoder.convolutions[encoder.convolutions.len() - 1].channels <= FEATURES
        })
}
