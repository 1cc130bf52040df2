//! Training steps of all engines against those of autograd with libtorch's own optimiser.

use cpn::archive::Tensors;
use cpn::engine::Native;
use cpn::learner::LearnerError;
use cpn::{Batch, EncoderConfig, Engine, Frames, Learner, Losses, MethodKind, Model, ModelConfig, Training};
use cpn_torch::loss::TensorBatch;
use cpn_torch::{Agent, Torch, tensors};
use tch::nn::OptimizerConfig;
use tch::{Cuda, Device, nn};
use testing::{noise_images, position_config, small_config, uniform};

const RATE: f64 = 1e-3;
const STEPS: usize = 5;

/// All engines of this machine.
fn engines() -> Vec<Box<dyn Engine>> {
    let cuda = if Cuda::is_available() { vec![Some(0)] } else { Vec::new() };
    let torch =
        [None].into_iter().chain(cuda).map(|device| Box::new(Torch::new(device, 1).unwrap()) as Box<dyn Engine>);
    [Box::new(Native { threads: 1 }) as Box<dyn Engine>].into_iter().chain(torch).collect()
}

fn configs() -> impl Iterator<Item = ModelConfig> {
    let position_dynamics = |config| ModelConfig { position_dynamics: true, ..config };
    let encoder = EncoderConfig::linear_position([500, 0, -200], 400);
    let linear = ModelConfig { encoder, ..position_config(MethodKind::Cpn) };
    let configs = MethodKind::ALL.into_iter().flat_map(|method| [small_config(method), position_config(method)]);
    configs.chain([small_config(MethodKind::Cpn), linear].map(position_dynamics))
}

/// Six samples of four frames.
fn batch(config: &ModelConfig, seed: u64) -> Batch {
    let samples = 6 * config.horizon as usize;
    let floats = |count, seed| uniform(count, seed).into_iter().map(|value| value as f32);
    let frames = match config.encoder.input() {
        cpn::Input::Image => Frames::Images(noise_images(4, seed)),
        cpn::Input::Position => {
            let metres: Vec<f32> = floats(12, seed).collect();
            Frames::Positions(metres.as_chunks().0.to_vec())
        }
    };
    Batch {
        frames,
        observations: vec![0, 1, 2, 0, 1, 3],
        goals: vec![3, 3, 3, 2, 2, 3],
        steps_left: vec![3, 2, 1, 40, 60, 200],
        actions: floats(samples * config.actions as usize, seed + 1).collect(),
        applied_actions: floats(samples * config.actions as usize, seed + 3).collect(),
        mask: floats(samples, seed + 2).map(|value| f32::from(value > -0.6)).collect(),
        next: if config.method.plans() { (0..samples).map(|i| i % 4).collect() } else { Vec::new() },
        positions: vec![[0.5, -1.0, 1.5]; 4],
    }
}

/// Settings with all losses that the model has.
fn training(config: &ModelConfig) -> Training {
    let plans = config.method.plans();
    let every_update = plans && !config.position_dynamics;
    let losses = Losses { every_update, dynamics: if plans { 0.5 } else { 0.0 }, position: 0.2 };
    Training { max_gradient_norm: 1.0, losses, ..Training::paper() }
}

/// Name of a weight that differs from the expected one by more than a tenth of a step.
fn differing(ours: &Tensors, expected: &Tensors) -> Option<String> {
    let elements = |tensors: &Tensors, name: &str| tensors[name].elements::<f32>().unwrap();
    let differs = |name: &&String| {
        let pairs = elements(ours, name).into_iter().zip(elements(expected, name));
        pairs.map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max) > 0.1 * RATE
    };
    assert_eq!(ours.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    expected.keys().find(differs).cloned()
}

/// Weights after training by autograd and libtorch's Adam.
fn by_libtorch(model: &Model) -> Tensors {
    let agent = Agent::new(model, Device::Cpu);
    let mut adam = nn::Adam::default().build(agent.variables(), RATE).unwrap();
    for step in 0..STEPS {
        let batch = TensorBatch::new(&batch(&model.config, step as u64), model.config.horizon, Device::Cpu);
        let Training { losses, max_gradient_norm, .. } = training(&model.config);
        adam.backward_step_clip_norm(&agent.outer_loss(&batch, losses), max_gradient_norm);
    }
    agent.variables().variables().iter().map(|(name, weight)| (name.clone(), tensors::to_archive(weight))).collect()
}

fn train(learner: &mut dyn Learner, steps: std::ops::Range<usize>) {
    let config = learner.model().config;
    for step in steps {
        let step = learner.step(&batch(&config, step as u64), RATE).unwrap();
        assert!(step.loss > 0.0 && step.gradient_norm > 0.0);
    }
}

#[test]
fn learners_agree_with_libtorchs_optimiser() {
    for config in configs() {
        // A small step size, as after some training: large updates of the actions amplify rounding errors.
        let mut model = Model::new(config, 3);
        model.weights.insert("step_size".to_owned(), cpn::archive::Tensor::new(&[], &[0.01f32]));
        let expected = by_libtorch(&model);
        assert!(differing(&model.weights, &expected).is_some(), "weights move");
        for engine in engines() {
            let mut learner = engine.learner(model.clone(), &training(&model.config)).unwrap();
            train(&mut *learner, 0..STEPS);
            assert_eq!(differing(&learner.model().weights, &expected), None, "{engine:?} {:?}", model.config);
        }
    }
}

/// Training from a restored state equals uninterrupted training; with another engine within rounding errors.
#[test]
fn training_continues_from_a_restored_state() {
    let model = Model::new(small_config(MethodKind::Cpn), 3);
    let learner = |engine: &dyn Engine| engine.learner(model.clone(), &training(&model.config)).unwrap();
    for engine in engines() {
        let (mut whole, mut first) = (learner(&*engine), learner(&*engine));
        train(&mut *whole, 0..STEPS);
        train(&mut *first, 0..2);
        for other in engines() {
            let mut second = learner(&*other);
            second.restore(&first.state(), 2).unwrap();
            assert_eq!(second.state(), first.state(), "{engine:?} {other:?}");
            train(&mut *second, 2..STEPS);
            if format!("{engine:?}") == format!("{other:?}") {
                assert_eq!(second.model(), whole.model(), "{engine:?}");
            } else {
                assert_eq!(differing(&second.model().weights, &whole.model().weights), None, "{engine:?} {other:?}");
            }
        }
    }
}

#[test]
fn a_state_that_does_not_fit_is_refused() {
    for engine in engines() {
        let learner = |method| {
            let config = small_config(method);
            engine.learner(Model::new(config.clone(), 3), &training(&config)).unwrap()
        };
        let mut state = learner(MethodKind::Cpn).state();
        state.remove("mean.step_size");
        let error = learner(MethodKind::Cpn).restore(&state, 1).unwrap_err().to_string();
        assert_eq!(error, "tensor \"mean.step_size\": expected F32[], got none such");
    }
}

#[test]
fn a_loss_that_is_not_finite_is_refused() {
    for engine in engines() {
        let model = Model::new(small_config(MethodKind::Bc), 3);
        let mut learner = engine.learner(model.clone(), &training(&model.config)).unwrap();
        let mut batch = batch(&model.config, 0);
        batch.actions[0] = f32::NAN;
        batch.mask[0] = 1.0;
        assert!(matches!(learner.step(&batch, RATE), Err(LearnerError::Loss(_))), "{engine:?}");
        assert_eq!(learner.model(), model, "{engine:?}: weights stay");
    }
}

#[test]
fn a_missing_device_is_named() {
    let error = Torch::new(Some(99), 1).unwrap_err().to_string();
    assert!(error.starts_with("device: expected one of ") && error.ends_with("got cuda:99"), "{error}");
}
