//! The fast outer gradient, as it is trained with, against autograd.

#![expect(clippy::unwrap_used, reason = "a test")]

use cpn::archive::Tensor as Archived;
use cpn::engine::OuterLoss;
use cpn::{Batch, Frames, MethodKind, Model, ModelConfig, Precision};
use cpn_torch::Agent;
use cpn_torch::loss::TensorBatch;
use tch::{Device, Tensor};
use testing::{noise_images, uniform};

/// Eight samples of seven frames; some are observation and goal, and some are so more than once.
fn batch(config: &ModelConfig) -> Batch {
    let samples = 8 * config.horizon as usize;
    let floats = |count, seed| uniform(count, seed).into_iter().map(|value| value as f32);
    Batch {
        frames: Frames::Images(noise_images(7, 1)),
        observations: vec![0, 1, 2, 3, 4, 0, 5, 5],
        goals: vec![6, 6, 6, 6, 6, 5, 4, 6],
        actions: floats(samples * config.actions as usize, 3).collect(),
        mask: floats(samples, 4).map(|value| f32::from(value > -0.6)).collect(),
    }
}

/// A model as after some training: with initial weights an update leaps, and every rounding with it.
fn model(method: MethodKind) -> Model {
    let mut model = Model::new(ModelConfig::paper(method), 3);
    model.weights.insert("step_size".to_owned(), Archived::new(&[], &[0.01f32]));
    model
}

/// Relative distances from autograd: of the loss, and of each weight's gradient by its length.
fn distances(method: MethodKind, precision: Precision) -> Vec<(String, f64)> {
    let model = model(method);
    let agent = Agent::new(&model, Device::Cpu);
    let batch = batch(&model.config);
    let ours = OuterLoss::new(&model.config, precision, 1).differentiate(&model.weights, &batch);
    let reference = agent.outer_loss(&TensorBatch::new(&batch, model.config.horizon, Device::Cpu));
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

#[test]
fn in_float32_it_is_autograds() {
    for method in MethodKind::ALL {
        for (name, distance) in distances(method, Precision::Float32) {
            assert!(distance < 2e-4, "{method} {name}: {distance}");
        }
    }
}

/// bfloat16 has 8 bits, and units near their edge switch: of eight samples of noise, each gradient keeps to within a third.
#[test]
fn in_bfloat16_it_is_close() {
    for method in MethodKind::ALL {
        let distances = distances(method, Precision::Bfloat16);
        for (name, distance) in &distances {
            assert!(*distance < 0.33, "{method} {name}: {distance}");
        }
        assert!(distances.iter().any(|(_, distance)| *distance > 1e-4), "{method}: it must have been used");
    }
}

/// The sums of a batch do not depend on how often it is computed; those of several threads come close.
#[test]
fn it_repeats_bit_for_bit() {
    let model = Model::new(ModelConfig::paper(MethodKind::Cpn), 3);
    let batch = batch(&model.config);
    let differentiate =
        |threads| OuterLoss::new(&model.config, Precision::Float32, threads).differentiate(&model.weights, &batch);
    let (first, again, threaded) = (differentiate(1), differentiate(1), differentiate(3));
    assert_eq!(first.weights, again.weights);
    assert!((first.loss - threaded.loss).abs() < 1e-5 * first.loss);
    for (name, weights) in &first.weights {
        let (ours, others) = (Tensor::from_slice(weights), Tensor::from_slice(&threaded.weights[name]));
        let length = ours.norm().double_value(&[]);
        assert!((&ours - others).norm().double_value(&[]) <= 1e-4 * length, "{name}");
    }
}
