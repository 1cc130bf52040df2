//! What a model is trained by, and the named choices of it.

use crate::config::{ConfigError, EncoderConfig, Input, MethodKind, ModelConfig, in_range};
use crate::precision::Precision;
use serde::{Deserialize, Serialize};

/// Which later frame of a demonstration a sample is to reach.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GoalSampling {
    /// The last, as in the paper (section "Experiment design").
    Final,
    /// Any that the plan can reach, one to horizon × action block steps later; as Universal Planning Networks are trained.
    WithinHorizon,
    /// Any later one (hindsight experience replay's `future`).
    Hindsight,
}

/// How the outer loop is run. With the model's configuration and the seed it decides the weights that some data lead to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Training {
    /// Passes over every frame that has an action.
    pub epochs: u32,
    /// Samples of a step.
    pub batch_size: usize,
    /// Samples that a batch takes from a demonstration at a time; 1 shuffles them one by one. Those of one demonstration
    /// share their final goal, which is then encoded once.
    pub samples_per_draw: usize,
    /// Which goals they are to reach.
    pub goals: GoalSampling,
    /// Steps that each planned action is held for; it is trained to be the mean of the demonstrated ones.
    pub action_block: usize,
    /// Largest shift of the images, in pixels, the same for all of a demonstration in a batch; 0 for none.
    pub shift_pixels: u32,
    /// Largest change of brightness and contrast, as a share; likewise; 0 for none.
    pub colour_jitter: f64,
    /// Highest learning rate of the one-cycle schedule of Adam.
    pub peak_learning_rate: f64,
    /// Longest gradient, as a norm over all weights.
    pub max_gradient_norm: f64,
    /// What the encoder computes in.
    pub precision: Precision,
}

/// A model and its training: all that decides the weights but the data and the seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// What is trained.
    pub model: ModelConfig,
    /// How.
    pub training: Training,
}

/// A recipe by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// Behaviour cloning, as the paper has it.
    PaperBc,
    /// Behaviour cloning with task embedding, as the paper has it.
    PaperTeBc,
    /// The universal planning network, as the paper has it.
    PaperUpn,
    /// The contextual planning network, as the paper has it.
    PaperCpn,
    /// The contextual planning network as we train it: in a tenth of the passes, and fast.
    Cpn,
    /// The contextual planning network of positions in the Jenga scene (section "JENGA domain on a physical robot").
    Jenga,
}

/// Where the hand and its goals are in the Jenga scene: the mean, in whole millimetres, of 21 demonstrations of `jenga-poke`
/// with the seeds 0 to 20, computed once.
const JENGA_CENTRE_MM: [i64; 3] = [631, 2, 187];
/// How far from there they are: the standard deviation, over all three axes.
const JENGA_SCALE_MM: i64 = 62;

impl Preset {
    /// All, in the order that they are listed in.
    pub const ALL: [Self; 6] = [Self::PaperBc, Self::PaperTeBc, Self::PaperUpn, Self::PaperCpn, Self::Cpn, Self::Jenga];

    /// The name, as it is typed.
    pub fn name(self) -> &'static str {
        match self {
            Self::PaperBc => "paper-bc",
            Self::PaperTeBc => "paper-te-bc",
            Self::PaperUpn => "paper-upn",
            Self::PaperCpn => "paper-cpn",
            Self::Cpn => "cpn",
            Self::Jenga => "jenga",
        }
    }

    /// What the name stands for.
    pub fn recipe(self) -> Recipe {
        let paper = |method| Recipe { model: ModelConfig::paper(method), training: Training::paper() };
        match self {
            Self::PaperBc => paper(MethodKind::Bc),
            Self::PaperTeBc => paper(MethodKind::TeBc),
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
        }
    }
}

impl Training {
    /// The paper's 50 epochs towards final goals; the rest it leaves open.
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
        }
    }

    /// Checks every value against its range.
    ///
    /// # Errors
    /// Names the first field out of its range, what was expected and what came.
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
        number("training.peak_learning_rate", self.peak_learning_rate, 1e-9..=1.0)?;
        number("training.max_gradient_norm", self.max_gradient_norm, 1e-9..=1e9)
    }
}

impl Recipe {
    /// Checks every value against its range. Only images can be changed at random.
    ///
    /// # Errors
    /// Names the first field out of its range, what was expected and what came.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.model.validate()?;
        if self.model.encoder.input() == Input::Position {
            in_range("training.shift_pixels", self.training.shift_pixels.into(), 0, 0)?;
            if self.training.colour_jitter != 0.0 {
                return Err(ConfigError::new("training.colour_jitter", self.training.colour_jitter, 0, 0));
            }
        }
        self.training.validate()
    }
}
