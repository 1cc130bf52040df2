//! Configuration of a model: method, encoder, sizes.

use crate::positions;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Maximum distance of a position from the origin on each axis: 1 km, in millimetres.
const MAX_MM: i64 = 1_000_000;

/// A learned method: those of the paper's comparison (section "Methods for comparison"), and behaviour cloning with the remaining
/// horizon.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MethodKind {
    /// Behaviour cloning from the observation alone.
    Bc,
    /// Behaviour cloning conditioned on the goal's embedding.
    TeBc,
    /// Behaviour cloning conditioned on the goal's embedding and the number of steps left to it: the goal-conditioned inverse
    /// dynamics model of arXiv 2605.08732.
    TeBcHorizon,
    /// Universal planning network: planning, without goal conditioning or neuromodulation.
    Upn,
    /// Contextual planning network: planning, conditioned on the goal's embedding, with neuromodulated layers.
    Cpn,
}

impl MethodKind {
    /// Every learned method, in the paper's order.
    pub const ALL: [Self; 5] = [Self::Bc, Self::TeBc, Self::TeBcHorizon, Self::Upn, Self::Cpn];

    /// True if the goal's embedding is an input of g_θ.
    pub fn is_goal_conditioned(self) -> bool {
        matches!(self, Self::TeBc | Self::TeBcHorizon | Self::Cpn)
    }

    /// True if the number of steps left to the goal is an input of g_θ.
    pub fn takes_steps_left(self) -> bool {
        self == Self::TeBcHorizon
    }

    /// True if actions come from the inner loop.
    pub fn plans(self) -> bool {
        matches!(self, Self::Upn | Self::Cpn)
    }

    /// True if the fully connected layers of g_θ are neuromodulated.
    pub fn is_neuromodulated(self) -> bool {
        self == Self::Cpn
    }

    /// Name in configuration, on the wire and in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bc => "bc",
            Self::TeBc => "te-bc",
            Self::TeBcHorizon => "te-bc-horizon",
            Self::Upn => "upn",
            Self::Cpn => "cpn",
        }
    }
}

impl fmt::Display for MethodKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One convolution, without padding, followed by a rectified linear unit.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConvConfig {
    /// Output channels.
    pub channels: i64,
    /// Kernel width and height in pixels.
    pub kernel: i64,
    /// Stride in pixels.
    pub stride: i64,
}

impl ConvConfig {
    const fn new(channels: i64, kernel: i64, stride: i64) -> Self {
        Self { channels, kernel, stride }
    }
}

/// Kind of observations and goals.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Input {
    /// Camera images, 84 x 84.
    Image,
    /// Positions in space.
    Position,
}

/// Encoder f_φ, by the kind of observations and goals.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum EncoderConfig {
    /// Camera images.
    Image(ImageEncoderConfig),
    /// Positions in space.
    Position(PositionEncoderConfig),
}

/// The image encoder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageEncoderConfig {
    /// Convolutions, in the order of evaluation.
    pub convolutions: Vec<ConvConfig>,
    /// Z, the size of the embedding.
    pub latent: i64,
    /// True if the embedding is layer-normalised, which keeps the inner loss on one scale.
    pub layer_norm: bool,
}

/// The encoder of positions (section "JENGA domain on a physical robot").
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PositionEncoderConfig {
    /// Offset subtracted from a position, x, y, z, in millimetres: integers, which JSON represents exactly.
    pub centre_mm: [i64; 3],
    /// Divisor of the difference, in millimetres: one for all axes, so that ratios of distances are preserved.
    pub scale_mm: i64,
    /// Widths of the linear layers before the last, each followed by a rectified linear unit.
    pub layers: Vec<i64>,
    /// Z, the size of the embedding.
    pub latent: i64,
    /// True if the embedding is layer-normalised.
    pub layer_norm: bool,
}

impl EncoderConfig {
    /// Our reading of the paper's encoder, whose widths are given only in a figure: the three convolutions customary for 84×84
    /// images, and a latent of 64.
    pub fn paper() -> Self {
        Self::Image(ImageEncoderConfig {
            convolutions: vec![ConvConfig::new(32, 8, 4), ConvConfig::new(64, 4, 2), ConvConfig::new(64, 3, 1)],
            latent: 64,
            layer_norm: true,
        })
    }

    /// Our encoder of positions with mean `centre_mm` and standard deviation `scale_mm`, in millimetres: the paper does not
    /// describe its own.
    pub fn position(centre_mm: [i64; 3], scale_mm: i64) -> Self {
        let layers = vec![64];
        Self::Position(PositionEncoderConfig { centre_mm, scale_mm, layers, latent: 16, layer_norm: true })
    }

    /// A linear encoder of positions with mean `centre_mm` and standard deviation `scale_mm`, in millimetres, for position dynamics.
    /// Training begins with the identity: an embedding is the standardised position.
    pub fn linear_position(centre_mm: [i64; 3], scale_mm: i64) -> Self {
        let (layers, latent) = (Vec::new(), positions::SIZE);
        Self::Position(PositionEncoderConfig { centre_mm, scale_mm, layers, latent, layer_norm: false })
    }

    /// True if an embedding is a linear function of a position.
    pub fn is_linear(&self) -> bool {
        matches!(self, Self::Position(position) if position.layers.is_empty() && !position.layer_norm)
    }

    /// Kind of observations that it embeds.
    pub fn input(&self) -> Input {
        match self {
            Self::Image(_) => Input::Image,
            Self::Position(_) => Input::Position,
        }
    }

    /// Z, the size of the embedding.
    pub fn latent(&self) -> i64 {
        match self {
            Self::Image(image) => image.latent,
            Self::Position(position) => position.latent,
        }
    }

    /// True if the embedding is layer-normalised.
    pub fn layer_norm(&self) -> bool {
        match self {
            Self::Image(image) => image.layer_norm,
            Self::Position(position) => position.layer_norm,
        }
    }

    fn validate(&self) -> Result<(), ConfigError> {
        match self {
            Self::Image(image) => {
                in_range("encoder.convolutions", image.convolutions.len() as i64, 1, 8)?;
                for conv in &image.convolutions {
                    in_range("encoder.convolutions.channels", conv.channels, 1, 128)?;
                    in_range("encoder.convolutions.kernel", conv.kernel, 1, 8)?;
                    in_range("encoder.convolutions.stride", conv.stride, 1, 16)?;
                }
                in_range("encoder output size in pixels", image.output_size().unwrap_or(0), 1, 16)?;
            }
            Self::Position(position) => {
                for centre in position.centre_mm {
                    in_range("encoder.centre_mm", centre, -MAX_MM, MAX_MM)?;
                }
                in_range("encoder.scale_mm", position.scale_mm, 1, MAX_MM)?;
                in_range("encoder.layers", position.layers.len() as i64, 0, 8)?;
                for &width in &position.layers {
                    in_range("encoder.layers.width", width, 1, 512)?;
                }
            }
        }
        in_range("encoder.latent", self.latent(), 1, 512)
    }
}

impl ImageEncoderConfig {
    /// Width and height after the last convolution, in pixels; `None` if an input is smaller than its kernel.
    pub fn output_size(&self) -> Option<i64> {
        self.convolutions.iter().try_fold(crate::images::SIZE, |size, conv| {
            (size >= conv.kernel).then(|| (size - conv.kernel) / conv.stride + 1)
        })
    }
}

/// Configuration of a model's architecture and planning, stored in its checkpoint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// Method of the comparison.
    pub method: MethodKind,
    /// Encoder f_φ.
    pub encoder: EncoderConfig,
    /// Width of the internal linear layers of g_θ.
    pub hidden: i64,
    /// Width of the hidden layer of the attenuation networks u_β and v_γ.
    pub gate_hidden: i64,
    /// A, the number of continuous actions.
    pub actions: i64,
    /// H, the number of planned steps; 1 for methods that do not plan.
    pub horizon: i64,
    /// U, the number of gradient updates of a plan; 0 for methods that do not plan.
    pub updates: i64,
    /// True if the first three elements of a state are the position of the hand: an action moves them by a linear function of its
    /// own, and the inner loss compares them alone. Training clones the policy's plan, before any update.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub position_dynamics: bool,
    /// N, the number of training goals whose embeddings are stored, to recognise goals of trained tasks; a training run on fewer
    /// episodes stores as many. 0 for none, and for methods that do not plan.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub familiar_goals: i64,
}

fn is_zero(number: &i64) -> bool {
    *number == 0
}

impl ModelConfig {
    /// The paper's values: layers of width 32, 4 actions, H = 5, U = 1.
    pub fn paper(method: MethodKind) -> Self {
        let (horizon, updates) = if method.plans() { (5, 1) } else { (1, 0) };
        Self {
            method,
            encoder: EncoderConfig::paper(),
            hidden: 32,
            gate_hidden: 32,
            actions: 4,
            horizon,
            updates,
            position_dynamics: false,
            familiar_goals: 0,
        }
    }

    /// Number of elements of a state, from the first on, that the inner loss and the dynamics loss compare.
    pub fn compared_elements(&self) -> i64 {
        if self.position_dynamics { positions::SIZE } else { self.encoder.latent() }
    }

    /// Number of updates that training differentiates through.
    pub fn trained_updates(&self) -> i64 {
        if self.position_dynamics { 0 } else { self.updates }
    }

    /// Width of the input of g_θ's trunk: x, x_g if the method is goal-conditioned, and k if it takes the number of steps left.
    pub fn trunk_inputs(&self) -> i64 {
        let latent = self.encoder.latent();
        let goal = if self.method.is_goal_conditioned() { latent } else { 0 };
        latent + goal + i64::from(self.method.takes_steps_left())
    }

    /// Checks every value against its range. The ranges bound a model's weights to a few hundred megabytes, so that a model can be
    /// built from an untrusted file.
    ///
    /// # Errors
    /// The first field out of its range, with the range and the value.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.encoder.validate()?;
        in_range("hidden", self.hidden, 1, 256)?;
        in_range("gate_hidden", self.gate_hidden, 1, 64)?;
        in_range("actions", self.actions, 1, 32)?;
        if self.position_dynamics {
            in_range("encoder.latent", self.encoder.latent(), positions::SIZE, 512)?;
        }
        if self.method.plans() {
            in_range("horizon", self.horizon, 1, 64)?;
            in_range("updates", self.updates, 0, 64)?;
            in_range("familiar_goals", self.familiar_goals, 0, 4096)
        } else {
            in_range("horizon", self.horizon, 1, 1)?;
            in_range("updates", self.updates, 0, 0)?;
            in_range("position_dynamics", self.position_dynamics.into(), 0, 0)?;
            in_range("familiar_goals", self.familiar_goals, 0, 0)
        }
    }
}

pub(crate) fn in_range(field: &'static str, value: i64, min: i64, max: i64) -> Result<(), ConfigError> {
    if (min..=max).contains(&value) { Ok(()) } else { Err(ConfigError::new(field, value, min, max)) }
}

/// Error of a configuration value out of its range.
#[derive(Debug, thiserror::Error)]
#[error("{field}: expected {min} to {max}, got {value}")]
pub struct ConfigError {
    /// Path of the field.
    pub field: &'static str,
    /// The invalid value.
    pub value: String,
    /// Minimum.
    pub min: String,
    /// Maximum.
    pub max: String,
}

impl ConfigError {
    pub(crate) fn new(field: &'static str, value: impl ToString, min: impl ToString, max: impl ToString) -> Self {
        Self { field, value: value.to_string(), min: min.to_string(), max: max.to_string() }
    }
}
