//! The fast outer gradient, as it is trained with, against autograd.

#![expect(clippy::unwrap_used, reason = "a test")]

mod common;

use common::{frames, noise_images, uniform};
use cpn::encoder::Precision;
use cpn::engine::OuterLoss;
use cpn::loss::Batch;
use cpn::{Agent, MethodKind, ModelConfig};
use tch::{Kind, Tensor};

/// Eight samples of seven frames; some are observation and goal, and some are so more than once.
fn batch(config: &ModelConfig) -> Batch {
    let mask = uniform(&[8, config.horizon], 4).gt(-0.6).to_kind(Kind::Float);
    Batch {
        frames: frames(&noise_images(7, 1)),
        observations: Tensor::from_slice(&[0i64, 1, 2, 3, 4, 0, 5, 5]),
        goals: Tensor::from_slice(&[6i64, 6, 6, 6, 6, 5, 4, 6]),
        actions: uniform(&[8, config.horizon, config.actions], 3).to_kind(Kind::Float),
        mask,
    }
}

/// How far ours are from autograd's gradients: of each weight, the length of the difference by the length.
fn distances(method: MethodKind, precision: Precision) -> Vec<(String, f64)> {
    let agent = Agent::new(ModelConfig::paper(method), 3);
    // As after some training: with the first weights an update leaps, and every rounding with it.
    let mut step_size = agent.variables().variables()["step_size"].shallow_clone();
    tch::no_grad(|| drop(step_size.fill_(0.01)));
    let batch = batch(agent.config());
    let ours = OuterLoss::new(&agent, precision, 1).differentiate(&agent, &batch);
    let reference = agent.outer_loss(&batch);
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

/// bfloat16 has 8 bits, and units near their edge switch: of eight samples of noise, each gradient keeps to within a fifth.
#[test]
fn in_bfloat16_it_is_close() {
    for method in MethodKind::ALL {
        let distances = distances(method, Precision::Bfloat16);
        for (name, distance) in &distances {
            assert!(*distance < 0.2, "{method} {name}: {distance}");
        }
        assert!(distances.iter().any(|(_, distance)| *distance > 1e-4), "{method}: it must have been used");
    }
}

/// The sums of a batch do not depend on how often it is computed; those of several threads come close.
#[test]
fn it_repeats_bit_for_bit() {
    let agent = Agent::new(ModelConfig::paper(MethodKind::Cpn), 3);
    let batch = batch(agent.config());
    let differentiate = |threads| OuterLoss::new(&agent, Precision::Float32, threads).differentiate(&agent, &batch);
    let (first, again, threaded) = (differentiate(1), differentiate(1), differentiate(3));
    assert_eq!(first.weights, again.weights);
    assert!((first.loss - threaded.loss).abs() < 1e-5 * first.loss);
    for (name, weights) in &first.weights {
        let (ours, others) = (Tensor::from_slice(weights), Tensor::from_slice(&threaded.weights[name]));
        let length = ours.norm().double_value(&[]);
        assert!((&ours - others).norm().double_value(&[]) <= 1e-4 * length, "{name}");
    }
}
