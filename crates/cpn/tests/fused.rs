//! The hand-derived outer gradient against autograd, in float64 and, as it is used, in float32.

#![expect(clippy::unwrap_used, reason = "a test")]

mod common;

use common::{small_config, uniform};
use cpn::fused::{OuterLoop, Samples, Weights};
use cpn::{MethodKind, ModelConfig, loss};
use std::collections::HashMap;
use tch::{Kind, Tensor};

struct Named(HashMap<String, Tensor>);

impl<T: tch::kind::Element + Copy> Weights<T> for Named {
    fn get(&self, name: &str) -> Vec<T> {
        Vec::try_from(self.0[name].flatten(0, -1)).unwrap()
    }
}

fn floats(tensor: &Tensor) -> Vec<f64> {
    Vec::try_from(tensor.to_kind(Kind::Double).flatten(0, -1)).unwrap()
}

fn check(config: ModelConfig, rows: i64, threads: usize) {
    let agent = common::double_agent(config.clone());
    let latent = config.encoder.latent();
    let scale = 2.0;
    let x = (uniform(&[rows, latent], 1) * scale).set_requires_grad(true);
    let x_g = (uniform(&[rows, latent], 2) * scale).set_requires_grad(true);
    let demonstrated = uniform(&[rows, config.horizon, config.actions], 3);
    let mask = uniform(&[rows, config.horizon], 4).gt(-0.6).to_kind(Kind::Double);

    let planned = agent.plan_differentiably(&x, &x_g);
    let reference = loss::behaviour_cloning(&planned, &demonstrated, &mask);
    reference.backward();

    let variables = Named(agent.variables().variables());
    let (xs, x_gs, actions, masks) = (floats(&x), floats(&x_g), floats(&demonstrated), floats(&mask));
    let samples = Samples { x: &xs, x_g: &x_gs, actions: &actions, mask: &masks };
    let ours = OuterLoop::new(config.clone(), threads).run(&variables, samples);
    let Named(variables) = variables;

    let close = |name: &str, ours: &[f64], reference: &Tensor| {
        let reference = floats(reference);
        assert_eq!(ours.len(), reference.len(), "{name}");
        let largest = reference.iter().fold(0.0f64, |m, r| m.max(r.abs()));
        for (o, r) in ours.iter().zip(&reference) {
            assert!((o - r).abs() < 1e-10 * (1.0 + largest), "{config:?} {name}: {o} for {r}");
        }
    };
    close("loss", &[ours.loss], &reference);
    close("x", &ours.x, &gradient(&x));
    close("x_g", &ours.x_g, &gradient(&x_g));
    let mut learnt = 0;
    for (name, ours) in &ours.weights {
        close(name, ours, &gradient(&variables[name]));
        learnt += usize::from(ours.iter().any(|value| *value != 0.0));
    }
    let by_autograd = variables.values().filter(|v| gradient(v).abs().max().double_value(&[]) > 0.0).count();
    assert_eq!(learnt, by_autograd, "{config:?}: every weight that autograd moves must be there");
}

/// What autograd left; zeros if nothing.
fn gradient(variable: &Tensor) -> Tensor {
    let gradient = variable.grad();
    if gradient.defined() { gradient } else { variable.zeros_like() }
}

#[test]
fn agrees_with_autograd() {
    for method in MethodKind::ALL {
        for (horizon, updates) in [(1, 0), (1, 1), (2, 1), (5, 1), (4, 0), (3, 2), (3, 3)] {
            if !method.plans() && (horizon, updates) != (1, 0) {
                continue;
            }
            for (rows, threads) in [(1, 1), (70, 1), (70, 3)] {
                check(ModelConfig { horizon, updates, ..small_config(method) }, rows, threads);
            }
        }
    }
}

/// At full size a block's gates come in several parts; 33 outputs leave a smaller last one.
#[test]
fn gates_in_parts_agree_with_autograd() {
    check(ModelConfig { horizon: 2, hidden: 33, ..ModelConfig::paper(MethodKind::Cpn) }, 20, 1);
}
