//! Small models, inputs, signatures and processes for tests.

pub mod process;
pub mod signatures;

use cpn::checkpoint::Provenance;
use cpn::config::{ConvConfig, ImageEncoderConfig, PositionEncoderConfig};
use cpn::{EncoderConfig, MethodKind, ModelConfig, images};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Configuration of a small model of images.
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

/// Configuration of a small model of positions, for a box of about 2 m.
pub fn position_config(method: MethodKind) -> ModelConfig {
    let (centre_mm, scale_mm, layers) = ([500, 0, -200], 400, vec![7, 5]);
    let encoder = PositionEncoderConfig { centre_mm, scale_mm, layers, latent: 6, layer_norm: true };
    ModelConfig { encoder: EncoderConfig::Position(encoder), actions: 3, ..small_config(method) }
}

/// Provenance without a render spec, of the paper's settings of training.
pub fn provenance(training_tasks: &[&str], seed: u64) -> Provenance {
    Provenance {
        training_tasks: training_tasks.iter().map(ToString::to_string).collect(),
        data_digest: "d".repeat(64),
        render_spec: String::new(),
        seed,
        training: cpn::Training::paper(),
    }
}

/// Bytes of `count` random images, RGB8.
pub fn noise_images(count: usize, seed: u64) -> Vec<u8> {
    let mut bytes = vec![0; count * images::BYTES];
    ChaCha8Rng::seed_from_u64(seed).fill(bytes.as_mut_slice());
    bytes
}

/// `count` random values in [-1, 1).
pub fn uniform(count: usize, seed: u64) -> Vec<f64> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    (0..count).map(|_| rng.random_range(-1.0..1.0)).collect()
}

/// Maximum number of features of [`encoders`]: with more, rounding in the linear layer exceeds 1e-5 in float32.
const FEATURES: i64 = 8192;

/// Random encoders of one or two convolutions: kernels of one to four strides, or a pixel more, so that images end with a tile or
/// within one.
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
