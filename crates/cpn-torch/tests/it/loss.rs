//! Outer loss and gradient of the native engine, in its training precisions, against autograd.

use cpn::archive::Tensor as Archived;
use cpn::engine::OuterLoss;
use cpn::{Batch, Frames, Losses, MethodKind, Model, ModelConfig, Precision};
use cpn_torch::Agent;
use cpn_torch::loss::TensorBatch;
use tch::{Device, Tensor};
use testing::{noise_images, uniform};

/// Eight samples of seven frames; some frames are both observation and goal, some are used repeatedly.
fn batch(config: &ModelConfig, losses: Losses) -> Batch {
    let samples = 8 * config.horizon as usize;
    let floats = |count, seed| uniform(count, seed).into_iter().map(|value| value as f32);
    Batch {
        frames: Frames::Images(noise_images(7, 1)),
        observations: vec![0, 1, 2, 3, 4, 0, 5, 5],
        goals: vec![6, 6, 6, 6, 6, 5, 4, 6],
        steps_left: vec![90, 75, 60, 45, 30, 15, 1, 200],
        actions: floats(samples * config.actions as usize, 3).collect(),
        applied_actions: floats(samples * config.actions as usize, 5).collect(),
        mask: floats(samples, 4).map(|value| f32::from(value > -0.6)).collect(),
        next: if losses.dynamics > 0.0 { (0..samples).map(|i| i % 7).collect() } else { Vec::new() },
        positions: if losses.position > 0.0 { vec![[0.5, -1.0, 1.5]; 7] } else { Vec::new() },
    }
}

/// A model with a small step size, as after some training: large updates of the actions amplify rounding errors.
fn model(method: MethodKind) -> Model {
    let mut model = Model::new(ModelConfig::paper(method), 3);
    model.weights.insert("step_size".to_owned(), Archived::new(&[], &[0.01f32]));
    model
}

/// Relative differences from autograd, of the loss and of each weight's gradient by its norm.
fn distances(method: MethodKind, losses: Losses, precision: Precision) -> Vec<(String, f64)> {
    let model = model(method);
    let agent = Agent::new(&model, Device::Cpu);
    let batch = batch(&model.config, losses);
    let ours = OuterLoss::new(&model.config, losses, precision, 1).differentiate(&model.weights, &batch);
    let reference = agent.outer_loss(&TensorBatch::new(&batch, model.config.horizon, Device::Cpu), losses);
    reference.backward();
    let expected = reference.double_value(&[]);
    let mut distances = vec![("loss".to_owned(), (ours.loss - expected).abs() / expected)];
    for (name, variable) in agent.variables().variables() {
        let gradient = variable.grad();
        let Some(ours) = ours.weights.get(&name) else {
            assert!(!gradient.defined() || gradient.abs().max().double_value(&[]) == 0.0, "{method} {name}");
            continue;
        };
        let ours = Tensor::from_slice(ours).view_as(&gradient);
        let length = gradient.norm().double_value(&[]);
        distances.push((name, (ours - gradient).norm().double_value(&[]) / length));
    }
    distances
}

/// No loss but behaviour cloning, and all that a method has.
fn losses(method: MethodKind) -> [Losses; 2] {
    let all = Losses { every_update: method.plans(), dynamics: if method.plans() { 0.5 } else { 0.0 }, position: 0.2 };
    [Losses::default(), all]
}

#[test]
fn float32_agrees_with_autograd() {
    for method in MethodKind::ALL {
        for losses in losses(method) {
            for (name, distance) in distances(method, losses, Precision::Float32) {
                assert!(distance < 2e-4, "{method} {losses:?} {name}: {distance}");
            }
        }
    }
}

/// bfloat16 has 8 bits, and rectified linear units near 0 switch: on eight random samples the gradients agree within a third.
#[test]
fn bfloat16_is_close_to_autograd() {
    for method in MethodKind::ALL {
        let distances = distances(method, Losses::default(), Precision::Bfloat16);
        for (name, distance) in &distances {
            assert!(*distance < 0.33, "{method} {name}: {distance}");
        }
        assert!(distances.iter().any(|(_, distance)| *distance > 1e-4), "{method}: it must have been used");
    }
}

/// Loss and gradient are bitwise reproducible for a number of threads, and nearly equal for different ones.
#[test]
fn gradients_are_reproducible() {
    let model = Model::new(ModelConfig::paper(MethodKind::Cpn), 3);
    let losses = losses(MethodKind::Cpn)[1];
    let batch = batch(&model.config, losses);
    let differentiate = |threads| {
        OuterLoss::new(&model.config, losses, Precision::Float32, threads).differentiate(&model.weights, &batch)
    };
    let (first, again, threaded) = (differentiate(1), differentiate(1), differentiate(3));
    assert_eq!(first.weights, again.weights);
    assert!((first.loss - threaded.loss).abs() < 1e-5 * first.loss);
    for (name, weights) in &first.weights {
        let (ours, others) = (Tensor::from_slice(weights), Tensor::from_slice(&threaded.weights[name]));
        let length = ours.norm().double_value(&[]);
        assert!((&ours - others).norm().double_value(&[]) <= 1e-4 * length, "{name}");
    }
}
