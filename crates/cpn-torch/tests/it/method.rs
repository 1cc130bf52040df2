//! Mathematical properties of the networks, the inner loop and the outer loop.

use crate::common::{new_agent, noise_images, paired, steps_left, uniform};
use cpn::{EncoderConfig, Losses, MethodKind, Model, ModelConfig};
use cpn_torch::inner_loop::InnerLoop;
use cpn_torch::loss::TensorBatch;
use cpn_torch::neuromodulated::Neuromodulated;
use cpn_torch::{Agent, tensors};
use tch::nn::{self, Module};
use tch::{Device, Kind, Tensor};
use testing::{position_config, small_config};

/// Tolerance of rounding errors in float64, amplified by an untrained model's large updates.
const ROUNDING: f64 = 1e-9;

fn max_difference(a: &Tensor, b: &Tensor) -> f64 {
    (a - b).abs().max().double_value(&[])
}

/// A batch for the outer loss.
fn batch(config: &ModelConfig, size: i64) -> TensorBatch {
    let inputs = |seed| match config.encoder {
        EncoderConfig::Image(_) => noise_images(size as usize, seed),
        EncoderConfig::Position(_) => uniform(&[size, 3], seed),
    };
    let (observations, goals) = (inputs(1), inputs(2));
    let actions = uniform(&[size, config.horizon, config.actions], 3);
    let mask = Tensor::ones([size, config.horizon], (Kind::Double, Device::Cpu));
    paired(&observations, &goals, &actions, &mask)
}

/// Outer gradients, of second order for planning methods, against central differences, at the largest components of each weight.
#[test]
fn outer_gradients_match_finite_differences() {
    let methods = MethodKind::ALL.into_iter();
    for config in methods.flat_map(|method| [small_config(method), position_config(method)]) {
        let method = config.method;
        let agent = new_agent(config);
        let batch = batch(agent.config(), 3);
        let loss = || agent.outer_loss(&batch, Losses::default());
        loss().backward();

        let mut seen = 0;
        for (name, variable) in agent.variables().variables() {
            if !variable.grad().defined() {
                assert_eq!(name, "step_size", "{method}: every other weight takes part");
                continue;
            }

            let gradient = variable.grad().view(-1);
            let index = gradient.abs().argmax(None, false).int64_value(&[]);
            let mut weight = variable.detach().view(-1).get(index);
            let mut nudged = |delta: f64| {
                weight += delta;
                let value = loss().double_value(&[]);
                weight -= delta;
                value
            };

            let numeric = (nudged(1e-6) - nudged(-1e-6)) / 2e-6;
            let analytic = gradient.double_value(&[index]);
            assert!(
                (numeric - analytic).abs() < 1e-6 + 1e-4 * analytic.abs(),
                "{method} {name}[{index}]: {numeric} by differences, {analytic} by the graph"
            );
            seen += 1;
        }
        assert!(seen > 8, "{method}");
    }
}

#[test]
fn the_step_size_learns_through_the_update() {
    for method in [MethodKind::Upn, MethodKind::Cpn] {
        let agent = new_agent(small_config(method));
        agent.outer_loss(&batch(agent.config(), 2), Losses::default()).backward();
        let gradient = agent.variables().variables()["step_size"].grad().double_value(&[]);
        assert!(gradient.abs() > 0.0, "{method}: the outer loss must depend on the inner update");
    }
}

#[test]
fn a_plan_does_not_depend_on_its_batch() {
    for method in MethodKind::ALL {
        let agent = new_agent(small_config(method));
        let (x, x_g) = (uniform(&[7, 6], 1), uniform(&[7, 6], 2));
        let together = agent.plan(&x, &x_g, &steps_left(7));
        for row in 0..7 {
            let [x, x_g, steps_left] = [&x, &x_g, &steps_left(7)].map(|rows| rows.narrow(0, row, 1));
            let alone = agent.plan(&x, &x_g, &steps_left);
            assert!(max_difference(&alone.actions, &together.actions.narrow(0, row, 1)) < ROUNDING, "{method}");
            for (a, b) in alone.inner_losses.iter().zip(&together.inner_losses) {
                assert!(max_difference(a, &b.narrow(0, row, 1)) < ROUNDING, "{method}");
            }
        }
    }
}

#[test]
fn plans_of_training_and_serving_are_equal() {
    let agent = new_agent(small_config(MethodKind::Cpn));
    let (x, x_g) = (uniform(&[2, 6], 1), uniform(&[2, 6], 2));
    let inner_loop = InnerLoop { updates: 3, ..agent.inner_loop() };
    let served = inner_loop.plan(&x, &x_g);
    let trained = inner_loop.plans_differentiably(&x, &x_g, 3);
    assert!(max_difference(&served.actions, &trained[3]) < 1e-12);
    assert_eq!((served.inner_losses.len(), trained.len()), (4, 4));
}

#[test]
fn without_updates_the_plan_is_the_policys_rollout() {
    let agent = new_agent(small_config(MethodKind::Cpn));
    let (x, x_g) = (uniform(&[2, 6], 1), uniform(&[2, 6], 2));
    let planned = InnerLoop { updates: 0, ..agent.inner_loop() }.plan(&x, &x_g).actions;
    let network = agent.inner_loop().network;
    let mut state = x;
    for step in 0..agent.horizon() {
        let features = network.features(&state, &x_g);
        let action = network.policy(&features);
        assert!(max_difference(&planned.select(1, step), &action) < 1e-12);
        state = network.next(&state, &features, &action);
    }
}

#[test]
fn a_small_update_lowers_the_inner_loss() {
    for method in [MethodKind::Upn, MethodKind::Cpn] {
        let agent = new_agent(small_config(method));
        let step_size = Tensor::from(1e-3);
        let inner_loop = InnerLoop { updates: 5, step_size: &step_size, ..agent.inner_loop() };
        let losses = inner_loop.plan(&uniform(&[4, 6], 1), &uniform(&[4, 6], 2)).inner_losses;
        for pair in losses.windows(2) {
            assert!(pair[1].lt_tensor(&pair[0]).all().int64_value(&[]) == 1, "{method}");
        }
    }
}

/// With all attenuation factors set to 1, the layer is an ordinary linear one.
#[test]
fn a_layer_without_attenuation_is_linear() {
    let mut store = nn::VarStore::new(Device::Cpu);
    let layer = Neuromodulated::new(&(store.root() / "layer"), 5, 3, 4);
    store.double();
    let variables = store.variables();
    let x = uniform(&[6, 5], 1);
    let linear = x.matmul(&variables["layer.weight"].tr()) + &variables["layer.bias"];
    assert!(max_difference(&layer.forward(&x), &linear) > 1e-3, "attenuation must matter to begin with");
    for gate in ["u", "v"] {
        let mut bias = variables[&format!("layer.{gate}.output.bias")].shallow_clone();
        let _ = tch::no_grad(|| bias.fill_(1e3));
    }
    assert!(max_difference(&layer.forward(&x), &linear) < 1e-12);
}

#[test]
fn methods_depend_on_their_inputs_as_configured() {
    for method in MethodKind::ALL {
        let agent = new_agent(small_config(method));
        let [x, goal, other_goal] = [1, 2, 3].map(|seed| uniform(&[4, 6], seed));
        let steps_left = steps_left(4);
        let actions = agent.plan(&x, &goal, &steps_left).actions;
        let change = |x: &Tensor, x_g: &Tensor, k: &Tensor| max_difference(&agent.plan(x, x_g, k).actions, &actions);
        assert!(change(&(&x + 0.1), &goal, &steps_left) > 0.0, "{method}");
        let by_goal = change(&x, &other_goal, &steps_left);
        assert_eq!(by_goal > 0.0, method != MethodKind::Bc, "{method}: only BC ignores the goal");
        let by_steps_left = change(&x, &goal, &(&steps_left + 0.1));
        assert_eq!(by_steps_left > 0.0, method == MethodKind::TeBcHorizon, "{method}: no other takes the steps left");
    }
}

#[test]
fn steps_past_the_demonstration_do_not_count() {
    let agent = new_agent(small_config(MethodKind::Cpn));
    let batch = batch(agent.config(), 2);
    let _ = batch.mask.get(1).narrow(0, 2, 3).fill_(0.0);
    let loss = || agent.outer_loss(&batch, Losses::default()).double_value(&[]);
    let before = loss();
    let _ = batch.actions.get(1).narrow(0, 2, 3).fill_(9.0);
    assert!((loss() - before).abs() < 1e-12);
}

/// The encoder is invariant to a common change of origin and scale of positions and configuration.
#[test]
fn positions_are_standardised() {
    let embed = |centre_mm, scale_mm, position| {
        let encoder = EncoderConfig::position(centre_mm, scale_mm);
        let config = ModelConfig { encoder, ..position_config(MethodKind::Cpn) };
        Agent::new(&Model::new(config, 0), Device::Cpu).encode(&tensors::from_positions(&[position]))
    };
    let (near, far) = (embed([0; 3], 100, [0.1, -0.05, 0.02]), embed([700, 200, -300], 200, [0.9, 0.1, -0.26]));
    assert!(max_difference(&near, &far) < 1e-5);
    assert!(max_difference(&near, &embed([0; 3], 100, [0.1, -0.05, 0.03])) > 1e-3);
}

#[test]
fn every_preset_builds() {
    for encoder in [EncoderConfig::paper(), EncoderConfig::position([500, 0, 200], 100)] {
        for method in MethodKind::ALL {
            let config = ModelConfig { encoder: encoder.clone(), ..ModelConfig::paper(method) };
            config.validate().unwrap();
            let agent = Agent::new(&Model::new(config, 0), Device::Cpu);
            let inputs = match encoder {
                EncoderConfig::Image(_) => noise_images(2, 0),
                EncoderConfig::Position(_) => tensors::from_positions(&[[0.5, 0.0, 0.2]; 2]),
            };
            let x = agent.encode(&inputs);
            assert_eq!(x.size(), [2, encoder.latent()]);
            let plan = agent.plan(&x, &x, &steps_left(2).to_kind(Kind::Float));
            assert_eq!(plan.actions.size(), [2, if method.plans() { 5 } else { 1 }, 4]);
        }
    }
}
