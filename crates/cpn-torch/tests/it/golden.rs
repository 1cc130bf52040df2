//! The method against golden tensors of an independent PyTorch implementation, `tests/golden/reference.py`.

use crate::common;
use cpn::archive::{self, Tensors};
use cpn::{Losses, ModelConfig};
use cpn_torch::{Agent, tensors};
use std::collections::BTreeMap;
use tch::{Kind, Tensor};

/// An agent with the reference's weights, in float64, and the other tensors of the reference.
fn load(method: &str) -> (Agent, BTreeMap<String, Tensor>) {
    let path = format!("{}/../../tests/golden/{method}.safetensors", env!("CARGO_MANIFEST_DIR"));
    let (archive, config): (Tensors, ModelConfig) = archive::from_bytes(&std::fs::read(path).unwrap()).unwrap();
    let tensors: BTreeMap<_, _> =
        archive.into_iter().map(|(name, tensor)| (name, tensors::from_archive(&tensor))).collect();
    let agent = common::new_agent(config);
    for (name, mut variable) in agent.variables().variables() {
        tch::no_grad(|| variable.copy_(&tensors[&format!("weight.{name}")]));
    }
    (agent, tensors)
}

fn assert_close(name: &str, ours: &Tensor, reference: &Tensor) {
    assert_eq!(ours.size(), reference.size(), "{name}");
    let error = (ours - reference).abs().max().double_value(&[]);
    assert!(error < 1e-10 * (1.0 + reference.abs().max().double_value(&[])), "{name}: {error:e}");
}

fn check(method: &str) {
    let (agent, golden) = load(method);
    let (x, x_g) = (agent.encode(&golden["observations"]), agent.encode(&golden["goals"]));
    assert_close("x", &x, &golden["x"]);
    assert_close("x_g", &x_g, &golden["x_g"]);

    let plan = agent.plan(&x, &x_g, &common::steps_left(x.size()[0]));
    assert_close("actions", &plan.actions, &golden["actions"]);
    assert_close("inner_losses", &Tensor::stack(&plan.inner_losses, 0), &golden["inner_losses"]);

    let mask = golden["mask"].to_kind(Kind::Double);
    let batch = common::paired(&golden["observations"], &golden["goals"], &golden["demonstrated"], &mask);
    let loss = agent.outer_loss(&batch, Losses::default());
    assert_close("outer_loss", &loss, &golden["outer_loss"]);
    loss.backward();
    for (name, variable) in agent.variables().variables() {
        let gradient = variable.grad();
        // Undefined of a weight that does not affect the loss: the step size without trained updates.
        let gradient = if gradient.defined() { gradient } else { variable.zeros_like() };
        assert_close(&name, &gradient, &golden[&format!("gradient.{name}")]);
    }
}

#[test]
fn upn_agrees_with_the_reference() {
    check("upn");
}

#[test]
fn cpn_agrees_with_the_reference() {
    check("cpn");
}

#[test]
fn position_dynamics_agree_with_the_reference() {
    check("cpn-position");
}
