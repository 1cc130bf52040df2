//! Recipes: model configurations with training settings, and the named presets.

use crate::config::{ConfigError, EncoderConfig, Input, MethodKind, ModelConfig, in_range};
use crate::precision::Precision;
use serde::{Deserialize, Serialize};

/// Choice of a sample's goal among the later frames of its demonstration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GoalSampling {
    /// The last frame, as in the paper (section "Experiment design").
    Final,
    /// A random frame within the plan's reach, one to horizon × action block steps later, as in Universal Planning Networks.
    WithinHorizon,
    /// A random later frame (hindsight experience replay's `future`).
    Hindsight,
}

/// Losses of the outer loop beside behaviour cloning of the last plan. The default is the paper's: none.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Losses {
    /// True if the plans before and after every update are cloned, all with the same weight, so that every number of updates up to
    /// the model's gives a policy.
    pub every_update: bool,
    /// Weight of the dynamics loss: the mean squared error between the states predicted under the applied actions, after one to
    /// H steps, and the embeddings of the frames that followed, which get no gradient from it. With position dynamics, of their first
    /// three elements.
    pub dynamics: f64,
    /// Weight of the position loss: the mean squared error between the first three elements of each frame's embedding and the
    /// position of the hand, standardised over the demonstrations. Only training needs positions.
    pub position: f64,
}

/// Training settings of the outer loop. With the model's configuration, the data and the seed they determine the weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Training {
    /// Passes over all frames with an action.
    pub epochs: u32,
    /// Batch size, in samples.
    pub batch_size: usize,
    /// Number of samples drawn from a demonstration at a time; 1 shuffles single samples. Samples of one demonstration in a batch
    /// share their final goal, which is then encoded once.
    pub samples_per_draw: usize,
    /// Choice of the samples' goals.
    pub goals: GoalSampling,
    /// Number of steps that a planned action is held for (action repeat); its target is the mean of the demonstrated actions.
    pub action_block: usize,
    /// Maximum random shift of images, in pixels; one shift for all images of a demonstration in a batch; 0 for none.
    pub shift_pixels: u32,
    /// Maximum relative change of brightness and contrast; one change for all images of a demonstration in a batch; 0 for none.
    pub colour_jitter: f64,
    /// Peak learning rate of Adam's one-cycle schedule.
    pub peak_learning_rate: f64,
    /// Maximum norm of the gradient over all weights; longer gradients are clipped.
    pub max_gradient_norm: f64,
    /// Arithmetic precision of the encoder.
    pub precision: Precision,
    /// Losses beside behaviour cloning of the last plan; none in checkpoints from before there were any.
    #[serde(default)]
    pub losses: Losses,
}

/// Configuration of a model and of its training. With the data and the seed it determines the weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Model configuration.
    pub model: ModelConfig,
    /// Training settings.
    pub training: Training,
}

/// Name of a predefined recipe.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// Behaviour cloning, as in the paper.
    PaperBc,
    /// Behaviour cloning with task embedding, as in the paper.
    PaperTeBc,
    /// Behaviour cloning with task embedding and remaining horizon: the paper's settings, with goals in hindsight.
    PaperTeBcHorizon,
    /// Universal planning network, as in the paper.
    PaperUpn,
    /// Contextual planning network, as in the paper.
    PaperCpn,
    /// Contextual planning network with our faster training: a tenth of the epochs, shared goals, and bfloat16.
    Cpn,
    /// As `cpn`, with position dynamics: five updates lead the hand to its position in the goal picture, for tasks without
    /// demonstrations. Familiar goals keep the policy's plan, for trained tasks.
    CpnPosition,
    /// Contextual planning network of positions in the Jenga scene (section "JENGA domain on a physical robot").
    Jenga,
    /// As `jenga`, with a linear encoder and position dynamics: updates lead to targets that no demonstration has.
    JengaPosition,
}

/// Mean position of the hand and its goals in the Jenga scene, in millimetres: of 21 demonstrations of `jenga-poke` with the seeds
/// 0 to 20.
const JENGA_CENTRE_MM: [i64; 3] = [631, 2, 187];
/// Standard deviation of these positions over all three axes, in millimetres.
const JENGA_SCALE_MM: i64 = 62;

impl Preset {
    /// All presets, in the order of lists.
    pub const ALL: [Self; 9] = [
        Self::PaperBc,
        Self::PaperTeBc,
        Self::PaperTeBcHorizon,
        Self::PaperUpn,
        Self::PaperCpn,
        Self::Cpn,
        Self::CpnPosition,
        Self::Jenga,
        Self::JengaPosition,
    ];

    /// Name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::PaperBc => "paper-bc",
            Self::PaperTeBc => "paper-te-bc",
            Self::PaperTeBcHorizon => "paper-te-bc-horizon",
            Self::PaperUpn => "paper-upn",
            Self::PaperCpn => "paper-cpn",
            Self::Cpn => "cpn",
            Self::CpnPosition => "cpn-position",
            Self::Jenga => "jenga",
            Self::JengaPosition => "jenga-position",
        }
    }

    /// The recipe of this name.
    pub fn recipe(self) -> Recipe {
        let paper = |method| Recipe { model: ModelConfig::paper(method), training: Training::paper() };
        match self {
            Self::PaperBc => paper(MethodKind::Bc),
            Self::PaperTeBc => paper(MethodKind::TeBc),
            Self::PaperTeBcHorizon => Recipe {
                model: ModelConfig::paper(MethodKind::TeBcHorizon),
                // With final goals, the number of steps left would be all but a clock of the demonstration.
                training: Training { goals: GoalSampling::Hindsight, ..Training::paper() },
            },
            Self::PaperUpn => paper(MethodKind::Upn),
            Self::PaperCpn => paper(MethodKind::Cpn),
            Self::Cpn => Recipe {
                model: ModelConfig::paper(MethodKind::Cpn),
                training: Training {
                    epochs: 5,
                    samples_per_draw: 8,
                    precision: Precision::Bfloat16,
                    ..Training::paper()
                },
            },
            Self::CpnPosition => {
                let Recipe { model, training } = Self::Cpn.recipe();
                Recipe {
                    model: ModelConfig { position_dynamics: true, updates: 5, familiar_goals: 1024, ..model },
                    training: Training {
                        losses: Losses { every_update: false, dynamics: 0.5, position: 30.0 },
                        ..training
                    },
                }
            }
            Self::Jenga => Recipe {
                model: ModelConfig {
                    encoder: EncoderConfig::position(JENGA_CENTRE_MM, JENGA_SCALE_MM),
                    actions: 3,
                    horizon: 8,
                    updates: 2,
                    ..ModelConfig::paper(MethodKind::Cpn)
                },
                training: Training { epochs: 60, batch_size: 64, ..Training::paper() },
            },
            Self::JengaPosition => {
                let Recipe { model, training } = Self::Jenga.recipe();
                Recipe {
                    model: ModelConfig {
                        encoder: EncoderConfig::linear_position(JENGA_CENTRE_MM, JENGA_SCALE_MM),
                        position_dynamics: true,
                        updates: 5,
                        ..model
                    },
                    training: Training {
                        losses: Losses { every_update: false, dynamics: 1.0, position: 1.0 },
                        ..training
                    },
                }
            }
        }
    }
}

impl Training {
    /// The paper's 50 epochs and final goals, and our choice of the settings that it leaves open.
    pub fn paper() -> Self {
        Self {
            epochs: 50,
            batch_size: 128,
            samples_per_draw: 1,
            goals: GoalSampling::Final,
            action_block: 1,
            shift_pixels: 0,
            colour_jitter: 0.0,
            peak_learning_rate: 1.5e-3,
            max_gradient_norm: 10.0,
            precision: Precision::Float32,
            losses: Losses::default(),
        }
    }

    /// Checks every value against its range.
    ///
    /// # Errors
    /// The first field out of its range, with the range and the value.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let count = |field, value: usize, max| in_range(field, i64::try_from(value).unwrap_or(i64::MAX), 1, max);
        count("training.epochs", self.epochs as usize, 100_000)?;
        count("training.batch_size", self.batch_size, 65_536)?;
        count("training.samples_per_draw", self.samples_per_draw, 65_536)?;
        count("training.action_block", self.action_block, 64)?;
        in_range("training.shift_pixels", self.shift_pixels.into(), 0, 16)?;
        let number = |field, value: f64, range: std::ops::RangeInclusive<f64>| {
            if range.contains(&value) {
                Ok(())
            } else {
                Err(ConfigError::new(field, value, range.start(), range.end()))
            }
        };
        number("training.colour_jitter", self.colour_jitter, 0.0..=0.5)?;
        number("training.losses.dynamics", self.losses.dynamics, 0.0..=1e6)?;
        number("training.losses.position", self.losses.position, 0.0..=1e6)?;
        number("training.peak_learning_rate", self.peak_learning_rate, 1e-9..=1.0)?;
        number("training.max_gradient_norm", self.max_gradient_norm, 1e-9..=1e9)
    }
}

impl Recipe {
    /// Checks every value against its range. Augmentation is allowed only with images, losses of plans only for methods that plan.
    /// Position dynamics need the dynamics loss and the position loss, and no layer normalisation of positions, which would bound
    /// them.
    ///
    /// # Errors
    /// The first field out of its range, with the range and the value.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.model.validate()?;
        if self.model.encoder.input() == Input::Position {
            in_range("training.shift_pixels", self.training.shift_pixels.into(), 0, 0)?;
            if self.training.colour_jitter != 0.0 {
                return Err(ConfigError::new("training.colour_jitter", self.training.colour_jitter, 0, 0));
            }
        }
        if self.training.losses.position > 0.0 {
            in_range("encoder.latent", self.model.encoder.latent(), 3, 512)?;
        }
        if self.model.position_dynamics {
            if self.model.encoder.input() == Input::Position {
                in_range("encoder.layer_norm", self.model.encoder.layer_norm().into(), 0, 0)?;
            }
            let Losses { every_update, dynamics, position } = self.training.losses;
            in_range("training.losses.every_update", every_update.into(), 0, 0)?;
            for (field, weight) in [("training.losses.dynamics", dynamics), ("training.losses.position", position)] {
                if weight == 0.0 {
                    return Err(ConfigError::new(field, weight, "above 0 (with position_dynamics)", 1e6));
                }
            }
        }
        if !self.model.method.plans() {
            let Losses { every_update, dynamics, .. } = self.training.losses;
            in_range("training.losses.every_update", every_update.into(), 0, 0)?;
            if dynamics != 0.0 {
                return Err(ConfigError::new("training.losses.dynamics", dynamics, 0, 0));
            }
        }
        self.training.validate()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn position_dynamics_need_their_losses_and_unbounded_positions() {
        let Recipe { model, training } = Preset::CpnPosition.recipe();
        let with =
            |losses| Recipe { model: model.clone(), training: Training { losses, ..training.clone() } }.validate();
        let losses = training.losses;
        assert!(with(losses).is_ok());
        for (losses, field) in [
            (Losses { every_update: true, ..losses }, "training.losses.every_update"),
            (Losses { dynamics: 0.0, ..losses }, "training.losses.dynamics"),
            (Losses { position: 0.0, ..losses }, "training.losses.position"),
        ] {
            assert_eq!(with(losses).map_err(|error| error.field), Err(field));
        }

        let with = |encoder| Recipe { model: ModelConfig { encoder, ..model.clone() }, training: training.clone() };
        assert!(with(EncoderConfig::linear_position([0; 3], 1)).validate().is_ok());
        let normalised = with(EncoderConfig::position([0; 3], 1));
        assert_eq!(normalised.validate().map_err(|error| error.field), Err("encoder.layer_norm"));

        let policy = ModelConfig { position_dynamics: true, ..ModelConfig::paper(MethodKind::TeBc) };
        assert_eq!(policy.validate().map_err(|error| error.field), Err("position_dynamics"));
    }

    #[test]
    fn familiar_goals_are_bounded_and_need_a_method_that_plans() {
        let with = |method, familiar_goals| ModelConfig { familiar_goals, ..ModelConfig::paper(method) }.validate();
        assert!(with(MethodKind::Upn, 4096).is_ok());
        for (method, count) in [(MethodKind::Upn, 4097), (MethodKind::Upn, -1), (MethodKind::TeBc, 1)] {
            assert_eq!(with(method, count).map_err(|error| error.field), Err("familiar_goals"));
        }
    }
}
