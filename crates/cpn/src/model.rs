//! Models: configuration and weights.

use crate::archive::{Tensor, Tensors};
use crate::config::{EncoderConfig, ImageEncoderConfig, ModelConfig, PositionEncoderConfig};
use crate::familiar::FamiliarGoals;
use crate::{images, positions};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Initial bias of the attenuation networks' outputs: sigmoid(2) = 0.88, so that a layer is almost linear at the start of
/// training.
const GATE_BIAS: f32 = 2.0;

/// Bound of the initial motion of the position by an action, in standard deviations of the position.
const POSITION_MOTION: f32 = 0.1;

/// A model: configuration and weights of the encoder f_φ, of g_θ and of the inner loop's step size.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// Sizes and method.
    pub config: ModelConfig,
    /// Weights by their names in a checkpoint, float32, in the shapes of [`parameters`].
    pub weights: Tensors,
    /// Goals of the training episodes; `None` before the end of training, and if the configuration stores none.
    pub familiar: Option<FamiliarGoals>,
}

/// A weight of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// Name in a checkpoint.
    pub name: String,
    /// Shape; empty for a scalar.
    pub shape: Vec<usize>,
    /// Distribution of the initial values.
    pub init: Init,
}

/// Distribution of a weight's initial values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// A constant.
    Constant(f32),
    /// Uniform between minus and plus a bound.
    Uniform(f32),
    /// 1 on a matrix's diagonal, else 0.
    Identity,
}

impl Model {
    /// A newly initialised model of a valid configuration. Equal seeds give equal weights, on every machine.
    pub fn new(config: ModelConfig, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut weight = |Parameter { name, shape, init }: Parameter| {
            let draw = |i: usize| match init {
                Init::Constant(value) => value,
                Init::Uniform(bound) => rng.random_range(-bound..=bound),
                Init::Identity => f32::from(i / shape[1] == i % shape[1]),
            };
            let elements: Vec<f32> = (0..shape.iter().product()).map(draw).collect();
            (name, Tensor::new(&shape, &elements))
        };
        let weights = parameters(&config).into_iter().map(&mut weight).collect();
        Self { config, weights, familiar: None }
    }

    /// Sets α of position dynamics, which are not trained through updates, to 2 / (H ‖W‖²), W being the motion of the position by an
    /// action, `[3, A]`. An update then takes two thirds of the way to the goal where all axes move alike, and cannot diverge where
    /// they do not. Other models stay as they are.
    pub fn set_position_step_size(&mut self) {
        if !self.config.position_dynamics {
            return;
        }
        let motion: Vec<f32> = self.weights["network.position.weight"].elements().expect("weights are float32");
        let norm_squared: f32 = motion.iter().map(|element| element * element).sum();
        let step_size = 2.0 / (self.config.horizon as f32 * norm_squared.max(f32::EPSILON));
        self.weights.insert("step_size".to_owned(), Tensor::new(&[], &[step_size]));
    }

    /// Stores the configured number of the training episodes' goals, given as embeddings by the trained encoder, `[Z]` each. With fewer
    /// episodes the configuration has their number from then on; without any there are no familiar goals.
    pub fn set_familiar_goals(&mut self, embeddings: &[Vec<f32>]) {
        let familiar = FamiliarGoals::new(embeddings, self.config.familiar_goals as usize);
        self.config.familiar_goals = familiar.count() as i64;
        self.familiar = (familiar.count() > 0).then_some(familiar);
    }
}

/// The weights of a valid configuration.
pub fn parameters(config: &ModelConfig) -> Vec<Parameter> {
    let mut list = Parameters(Vec::new());
    list.encoder(&config.encoder);
    list.network(config);
    list.push("step_size", &[], Init::Constant(1.0));
    list.0
}

/// Weights in the order of their initialisation.
struct Parameters(Vec<Parameter>);

impl Parameters {
    fn push(&mut self, name: &str, shape: &[i64], init: Init) {
        let shape = shape.iter().map(|&size| size as usize).collect();
        self.0.push(Parameter { name: name.to_owned(), shape, init });
    }

    /// The weight of a layer before a rectified linear unit, initialised as by He et al. (2015): uniform, of variance 2 / fan-in.
    fn weight(&mut self, name: &str, shape: &[i64]) {
        let fan_in: i64 = shape[1..].iter().product();
        self.push(&format!("{name}.weight"), shape, Init::Uniform((6.0 / fan_in as f32).sqrt()));
    }

    fn bias(&mut self, name: &str, size: i64, init: Init) {
        self.push(&format!("{name}.bias"), &[size], init);
    }

    fn linear(&mut self, name: &str, inputs: i64, outputs: i64) {
        self.weight(name, &[outputs, inputs]);
        self.bias(name, outputs, Init::Uniform(1.0 / (inputs as f32).sqrt()));
    }

    fn encoder(&mut self, config: &EncoderConfig) {
        let features = match config {
            EncoderConfig::Image(config) => self.image_features(config),
            EncoderConfig::Position(config) => self.position_features(config),
        };
        let latent = config.latent();
        if config.is_linear() {
            self.push("encoder.linear.weight", &[latent, features], Init::Identity);
            self.bias("encoder.linear", latent, Init::Constant(0.0));
        } else {
            self.linear("encoder.linear", features, latent);
        }
        if config.layer_norm() {
            self.push("encoder.norm.weight", &[latent], Init::Constant(1.0));
            self.bias("encoder.norm", latent, Init::Constant(0.0));
        }
    }

    /// The convolutions; returns F, the number of features.
    fn image_features(&mut self, config: &ImageEncoderConfig) -> i64 {
        let mut channels = images::CHANNELS;
        for (i, conv) in config.convolutions.iter().enumerate() {
            let name = format!("encoder.conv.{i}");
            self.weight(&name, &[conv.channels, channels, conv.kernel, conv.kernel]);
            self.bias(&name, conv.channels, Init::Constant(0.0));
            channels = conv.channels;
        }
        let size = config.output_size().expect("validated configuration");
        channels * size * size
    }

    /// The linear layers; returns F, the number of features.
    fn position_features(&mut self, config: &PositionEncoderConfig) -> i64 {
        let mut width = positions::SIZE;
        for (i, &outputs) in config.layers.iter().enumerate() {
            self.linear(&format!("encoder.layer.{i}"), width, outputs);
            width = outputs;
        }
        width
    }

    /// g_θ: the trunk, the policy branch and, for methods that plan, the dynamics branch.
    fn network(&mut self, config: &ModelConfig) {
        let ModelConfig { method, hidden, actions, .. } = *config;
        let latent = config.encoder.latent();

        self.dense("network.trunk", config.trunk_inputs(), hidden, config);
        self.dense("network.policy_0", hidden, hidden, config);
        self.dense("network.policy_1", hidden, actions, config);
        if method.plans() {
            self.dense("network.dynamics_0", hidden + actions, hidden, config);
            self.dense("network.dynamics_1", hidden, latent, config);
        }
        if config.position_dynamics {
            self.push("network.position.weight", &[positions::SIZE, actions], Init::Uniform(POSITION_MOTION));
        }
    }

    /// A fully connected layer, with its attenuation networks if it is neuromodulated.
    fn dense(&mut self, name: &str, inputs: i64, outputs: i64, config: &ModelConfig) {
        self.linear(name, inputs, outputs);
        if config.method.is_neuromodulated() {
            for (gate, attenuated) in [("u", outputs * inputs), ("v", outputs)] {
                self.linear(&format!("{name}.{gate}.hidden"), inputs, config.gate_hidden);
                let output = format!("{name}.{gate}.output");
                self.weight(&output, &[attenuated, config.gate_hidden]);
                self.bias(&output, attenuated, Init::Constant(GATE_BIAS));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::MethodKind;

    #[test]
    fn weights_follow_their_seed_and_stay_within_their_bounds() {
        for method in MethodKind::ALL {
            let config = ModelConfig::paper(method);
            let model = Model::new(config.clone(), 3);
            assert_eq!(model, Model::new(config.clone(), 3));
            assert_ne!(model, Model::new(config.clone(), 4));
            for Parameter { name, shape, init } in parameters(&config) {
                let tensor = &model.weights[&name];
                assert_eq!(tensor.shape(), shape, "{name}");
                let elements: Vec<f32> = tensor.elements().expect("float32");
                match init {
                    Init::Constant(value) => assert!(elements.iter().all(|element| *element == value), "{name}"),
                    Init::Identity => unreachable!("a model of images"),
                    Init::Uniform(bound) => {
                        let largest = elements.iter().fold(0.0f32, |most, element| most.max(element.abs()));
                        assert!(largest <= bound && largest > bound / 2.0, "{name}: {largest} of {bound}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_step_size_of_position_dynamics_is_two_thirds_of_the_way_to_the_goal() {
        let config =
            ModelConfig { position_dynamics: true, horizon: 4, actions: 3, ..ModelConfig::paper(MethodKind::Cpn) };
        let step_size = |model: &Model| model.weights["step_size"].elements::<f32>().expect("float32")[0];
        let mut model = Model::new(config, 0);
        let motion = [0.5f32, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.5];
        model.weights.insert("network.position.weight".to_owned(), Tensor::new(&[3, 3], &motion));
        model.set_position_step_size();
        // An update moves the position by α H W Wᵀ times the error.
        assert_eq!(step_size(&model) * 4.0 * 0.25, 2.0 / 3.0);

        let mut model = Model::new(ModelConfig::paper(MethodKind::Cpn), 0);
        model.set_position_step_size();
        assert_eq!(step_size(&model), 1.0);
    }

    #[test]
    fn a_linear_encoder_begins_as_the_identity() {
        let encoder = EncoderConfig::linear_position([0; 3], 1);
        let model = Model::new(ModelConfig { encoder, ..ModelConfig::paper(MethodKind::Cpn) }, 0);
        let elements: Vec<f32> = model.weights["encoder.linear.weight"].elements().expect("float32");
        assert_eq!(elements, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    }

    /// A change here changes all trained weights.
    #[test]
    fn the_stream_of_initial_values_is_fixed() {
        let model = Model::new(ModelConfig::paper(MethodKind::Cpn), 0);
        let elements: Vec<f32> = model.weights["network.trunk.weight"].elements().expect("float32");
        assert_eq!(elements[..2], [-0.12922287, 0.17566977]);
    }
}
