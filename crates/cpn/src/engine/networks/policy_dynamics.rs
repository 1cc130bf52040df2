//! Policy dynamics network g_θ, with its four passes over one step of a rollout.

use super::position_dynamics::PositionDynamics;
use crate::config::ModelConfig;
use crate::engine::layers::dense::{Dense, DenseGradient, LayerTape};
use crate::engine::layers::linear::Weights;
use crate::engine::layers::neuromodulated::gated_weights::Scratch;
use crate::engine::layers::passes::Order;
use crate::engine::layers::relu::{relu, relu_mask};
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::add;

/// Names of the branches' layers.
const POLICY: [&str; 2] = ["policy_0", "policy_1"];
const DYNAMICS: [&str; 2] = ["dynamics_0", "dynamics_1"];

/// The network g_θ: a trunk, with branches for the action and for the next state.
#[derive(Debug)]
pub struct PolicyDynamics<T> {
    trunk: Dense<T>,
    policy: [Dense<T>; 2],
    dynamics: Option<[Dense<T>; 2]>,
    pub position: Option<PositionDynamics<T>>,
    pub sizes: Sizes,
}

/// Widths of the network.
#[derive(Debug, Clone, Copy)]
pub struct Sizes {
    /// Z, the size of a state.
    pub latent: usize,
    /// Number of elements of a state that the inner loss and the dynamics loss compare.
    pub compared: usize,
    /// Width of the trunk's features and of the hidden layers.
    pub hidden: usize,
    /// A, the number of actions.
    pub actions: usize,
    /// Width of the trunk's input, [`ModelConfig::trunk_inputs`].
    pub trunk_inputs: usize,
}

/// Inputs of the trunk beside the state; a method without such inputs ignores them.
#[derive(Debug, Clone, Copy)]
pub struct Context<'a, T> {
    /// x_g, `[R, Z]`.
    pub x_g: &'a [T],
    /// k, the scaled number of steps left, `[R]`.
    pub steps_left: &'a [T],
}

/// Gradient of a loss in the network's weights.
#[derive(Debug)]
pub struct PolicyDynamicsGradient<T> {
    pub trunk: DenseGradient<T>,
    pub policy: [DenseGradient<T>; 2],
    pub dynamics: Option<[DenseGradient<T>; 2]>,
    /// `[P, A]`.
    pub position: Option<Vec<T>>,
}

/// Tape of a step: intermediates for later passes.
#[derive(Debug)]
pub struct StepTape<T> {
    trunk: LayerTape<T>,
    policy: [LayerTape<T>; 2],
    dynamics: Option<[LayerTape<T>; 2]>,
    /// The trunk's features `[R, hidden]`.
    features: AlignedVec<T>,
    /// The policy's proposed action, `[R, A]`.
    proposed: AlignedVec<T>,
}

/// Scratch buffers of a pass, shared by the steps.
#[derive(Debug)]
pub struct Buffers<T> {
    gates: Scratch<T>,
    /// Gradients in features and action, or in the trunk's inputs.
    wide: AlignedVec<T>,
    narrow: AlignedVec<T>,
}

impl<T: Element> PolicyDynamics<T> {
    /// The network of a valid configuration.
    pub fn new(config: &ModelConfig, weights: &impl Weights<T>) -> Self {
        let method = config.method;
        let (latent, hidden) = (config.encoder.latent() as usize, config.hidden as usize);
        let layer = |name: &str, rectified| {
            Dense::named(&format!("network.{name}"), rectified, weights, method.is_neuromodulated())
        };
        let after_relu = |name: &str| layer(name, hidden);
        Self {
            trunk: layer("trunk", 0),
            policy: POLICY.map(after_relu),
            dynamics: method.plans().then(|| DYNAMICS.map(after_relu)),
            position: PositionDynamics::new(config, weights),
            sizes: Sizes {
                latent,
                compared: config.compared_elements() as usize,
                hidden,
                actions: config.actions as usize,
                trunk_inputs: config.trunk_inputs() as usize,
            },
        }
    }

    /// A zero gradient.
    pub fn gradient(&self) -> PolicyDynamicsGradient<T> {
        PolicyDynamicsGradient {
            trunk: self.trunk.gradient(),
            policy: self.policy.each_ref().map(Dense::gradient),
            dynamics: self.dynamics.as_ref().map(|layers| layers.each_ref().map(Dense::gradient)),
            position: self.position.as_ref().map(PositionDynamics::gradient),
        }
    }

    /// A gradient by the weights' names in a checkpoint, without the prefix `network.`.
    pub fn in_weights(&self, gradient: &PolicyDynamicsGradient<T>) -> Vec<(String, Vec<T>)> {
        let mut weights = self.trunk.in_weights("trunk", &gradient.trunk);
        for ((name, layer), gradient) in POLICY.iter().zip(&self.policy).zip(&gradient.policy) {
            weights.extend(layer.in_weights(name, gradient));
        }
        let dynamics = self.dynamics.iter().flatten().zip(gradient.dynamics.iter().flatten());
        for (name, (layer, gradient)) in DYNAMICS.iter().zip(dynamics) {
            weights.extend(layer.in_weights(name, gradient));
        }
        weights.extend(gradient.position.iter().map(|gradient| ("position.weight".to_owned(), gradient.clone())));
        weights
    }

    /// A step's tape for blocks of up to R = `rows` samples.
    pub fn tape(&self, rows: usize) -> StepTape<T> {
        let tapes = |layers: &[Dense<T>; 2]| layers.each_ref().map(|layer| layer.tape(rows));
        StepTape {
            trunk: self.trunk.tape(rows),
            policy: tapes(&self.policy),
            dynamics: self.dynamics.as_ref().map(tapes),
            features: zeros(rows * self.sizes.hidden),
            proposed: zeros(rows * self.sizes.actions),
        }
    }

    /// Buffers for blocks of up to R = `rows` samples.
    pub fn buffers(&self, rows: usize) -> Buffers<T> {
        let Sizes { latent, hidden, actions, trunk_inputs, .. } = self.sizes;
        Buffers {
            gates: Scratch::new(),
            wide: zeros(rows * trunk_inputs.max(hidden + actions)),
            narrow: zeros(rows * latent.max(hidden)),
        }
    }

    /// The trunk: records features of x, `[R, Z]`, and its context on the tape.
    pub fn features(&self, rows: usize, step: &mut StepTape<T>, x: &[T], context: Context<'_, T>) {
        let Sizes { latent, trunk_inputs, .. } = self.sizes;
        for (r, input) in step.trunk.x(rows).chunks_exact_mut(trunk_inputs).enumerate() {
            let row = r * latent..(r + 1) * latent;
            let (state, rest) = input.split_at_mut(latent);
            state.copy_from_slice(&x[row.clone()]);
            if let Some((goal, rest)) = rest.split_at_mut_checked(latent) {
                goal.copy_from_slice(&context.x_g[row]);
                // One column, or none.
                rest.fill(context.steps_left[r]);
            }
        }
        let features = &mut step.features[..rows * self.sizes.hidden];
        self.trunk.forward(rows, &mut step.trunk, features);
        relu(features);
    }

    /// The policy branch: the proposed action, `[R, A]`, from the features on the tape.
    pub fn policy(&self, rows: usize, step: &mut StepTape<T>, action: &mut [T]) {
        let [first, second] = &mut step.policy;
        first.x(rows).copy_from_slice(&step.features[..rows * self.sizes.hidden]);
        self.policy[0].forward(rows, first, second.x(rows));
        relu(second.x(rows));
        self.policy[1].forward(rows, second, action);
        for value in &mut *action {
            *value = value.tanh();
        }
        step.proposed[..action.len()].copy_from_slice(action);
    }

    /// The dynamics branch: replaces x, `[R, Z]`, by the next state, from an action, `[R, A]`, and the features on the tape.
    pub fn next(&self, rows: usize, step: &mut StepTape<T>, action: &[T], x: &mut [T], buffers: &mut Buffers<T>) {
        let Some((layers, [first, second])) = self.dynamics.as_ref().zip(step.dynamics.as_mut()) else { return };
        let Sizes { latent, hidden, actions, .. } = self.sizes;
        for (r, input) in first.x(rows).chunks_exact_mut(hidden + actions).enumerate() {
            input[..hidden].copy_from_slice(&step.features[r * hidden..][..hidden]);
            input[hidden..].copy_from_slice(&action[r * actions..][..actions]);
        }

        layers[0].forward(rows, first, second.x(rows));
        relu(second.x(rows));
        let change = &mut buffers.narrow[..rows * latent];
        layers[1].forward(rows, second, change);
        match &self.position {
            Some(position) => {
                position.clear(change);
                add(x, change);
                position.next(action, x);
            }
            None => add(x, change),
        }
    }

    /// The gradient in state and action, without position dynamics: replaces x̄ after the step, `[R, Z]`, by x̄ before it, unless
    /// `is_first`, and writes ā, `[R, A]`.
    pub fn vjp(
        &self,
        rows: usize,
        is_first: bool,
        step: &mut StepTape<T>,
        x_bar: &mut [T],
        action_bar: &mut [T],
        buffers: &mut Buffers<T>,
    ) {
        let Some((layers, [first, second])) = self.dynamics.as_ref().zip(step.dynamics.as_mut()) else { return };
        let Sizes { latent, hidden, actions, trunk_inputs, .. } = self.sizes;

        // Backward through the dynamics branch, to features and action.
        second.y_bar(rows).copy_from_slice(x_bar);
        first.y_bar(rows).fill(T::ZERO);
        layers[1].vjp(rows, second, &mut buffers.gates, first.y_bar(rows));
        relu_mask(first.y_bar(rows), second.x(rows));
        let wide = &mut buffers.wide[..rows * (hidden + actions)];
        wide.fill(T::ZERO);
        layers[0].vjp(rows, first, &mut buffers.gates, wide);
        let features_bar = step.trunk.y_bar(rows);
        for (r, row) in wide.chunks_exact(hidden + actions).enumerate() {
            features_bar[r * hidden..][..hidden].copy_from_slice(&row[..hidden]);
            action_bar[r * actions..][..actions].copy_from_slice(&row[hidden..]);
        }
        if is_first {
            return;
        }

        // Backward through the trunk, to the state.
        relu_mask(features_bar, &step.features);
        let wide = &mut buffers.wide[..rows * trunk_inputs];
        wide.fill(T::ZERO);
        self.trunk.vjp(rows, &mut step.trunk, &mut buffers.gates, wide);
        for (x_bar, row) in x_bar.chunks_exact_mut(latent).zip(wide.chunks_exact(trunk_inputs)) {
            add(x_bar, &row[..latent]);
        }
    }

    /// The tangent of the next state, without position dynamics: replaces ẋ, `[R, Z]`, from ȧ, `[R, A]`. At the first step ẋ is 0.
    pub fn jvp(
        &self,
        rows: usize,
        is_first: bool,
        step: &mut StepTape<T>,
        action_dot: &[T],
        x_dot: &mut [T],
        buffers: &mut Buffers<T>,
    ) {
        let Some((layers, [first, second])) = self.dynamics.as_ref().zip(step.dynamics.as_mut()) else { return };
        let Sizes { latent, hidden, actions, trunk_inputs, .. } = self.sizes;

        // The trunk.
        let features_dot = &mut buffers.narrow[..rows * hidden];
        if is_first {
            features_dot.fill(T::ZERO);
        } else {
            for (input, x_dot) in step.trunk.x_dot(rows).chunks_exact_mut(trunk_inputs).zip(x_dot.chunks_exact(latent))
            {
                input[..latent].copy_from_slice(x_dot);
                input[latent..].fill(T::ZERO);
            }
            self.trunk.jvp(rows, &mut step.trunk, features_dot);
            relu_mask(features_dot, &step.features);
        }

        // The dynamics branch.
        for (r, input) in first.x_dot(rows).chunks_exact_mut(hidden + actions).enumerate() {
            input[..hidden].copy_from_slice(&features_dot[r * hidden..][..hidden]);
            input[hidden..].copy_from_slice(&action_dot[r * actions..][..actions]);
        }
        let hidden_dot = &mut buffers.narrow[..rows * hidden];
        layers[0].jvp(rows, first, hidden_dot);
        relu_mask(hidden_dot, second.x(rows));
        second.x_dot(rows).copy_from_slice(hidden_dot);
        let change = &mut buffers.narrow[..rows * latent];
        layers[1].jvp(rows, second, change);
        add(x_dot, change);
    }

    /// The gradient of Φ: replaces x̂ after the step, `[R, Z]`, by x̂ before it, and adds to x̂_g, to â, `[R, A]`, and to the
    /// weights' gradient. The pass through position dynamics is of the first order.
    pub fn double_backward(
        &self,
        rows: usize,
        branches: Branches,
        step: &mut StepTape<T>,
        hat: &mut Cotangents<'_, T>,
        gradient: &mut PolicyDynamicsGradient<T>,
        buffers: &mut Buffers<T>,
    ) {
        let Sizes { latent, hidden, actions, trunk_inputs, .. } = self.sizes;
        let features_hat = &mut buffers.narrow[..rows * hidden];
        features_hat.fill(T::ZERO);
        let gates = &mut buffers.gates;

        // Backward through the dynamics branch, to features and action.
        if let (Some(order), Some(layers), Some([first, second]), Some(gradients)) =
            (branches.dynamics, &self.dynamics, &mut step.dynamics, &mut gradient.dynamics)
        {
            second.y_hat(rows).copy_from_slice(hat.x);
            if let Some(position) = &self.position {
                position.clear(second.y_hat(rows));
            }
            first.y_hat(rows).fill(T::ZERO);
            layers[1].double_backward(rows, order, second, gates, first.y_hat(rows), &mut gradients[1]);
            relu_mask(first.y_hat(rows), second.x(rows));
            let wide = &mut buffers.wide[..rows * (hidden + actions)];
            wide.fill(T::ZERO);
            layers[0].double_backward(rows, order, first, gates, wide, &mut gradients[0]);
            for (r, row) in wide.chunks_exact(hidden + actions).enumerate() {
                features_hat[r * hidden..][..hidden].copy_from_slice(&row[..hidden]);
                add(&mut hat.action[r * actions..][..actions], &row[hidden..]);
            }
            if let (Some(position), Some(gradient)) = (&self.position, &mut gradient.position) {
                position.vjp(hat.x, hat.action);
                let inputs = first.x(rows).chunks_exact(hidden + actions);
                position.accumulate(inputs.map(|input| &input[hidden..]), hat.x, gradient);
            }
        }

        // Backward through the policy branch, to the features.
        if branches.policy {
            let [first, second] = &mut step.policy;
            let proposed = step.proposed.iter().zip(&*hat.action);
            for (y_hat, (proposed, action_hat)) in second.y_hat(rows).iter_mut().zip(proposed) {
                *y_hat = *action_hat * (T::ONE - *proposed * *proposed);
            }
            first.y_hat(rows).fill(T::ZERO);
            self.policy[1].double_backward(
                rows,
                Order::First,
                second,
                gates,
                first.y_hat(rows),
                &mut gradient.policy[1],
            );
            relu_mask(first.y_hat(rows), second.x(rows));
            self.policy[0].double_backward(rows, Order::First, first, gates, features_hat, &mut gradient.policy[0]);
        }

        // Backward through the trunk, to state and goal.
        relu_mask(features_hat, &step.features);
        step.trunk.y_hat(rows).copy_from_slice(features_hat);
        let wide = &mut buffers.wide[..rows * trunk_inputs];
        wide.fill(T::ZERO);
        self.trunk.double_backward(rows, branches.trunk, &mut step.trunk, gates, wide, &mut gradient.trunk);
        let rows_of = hat.x.chunks_exact_mut(latent).zip(hat.x_g.chunks_exact_mut(latent));
        for ((x_hat, x_g_hat), row) in rows_of.zip(wide.chunks_exact(trunk_inputs)) {
            add(x_hat, &row[..latent]);
            // Without the number of steps left, which does not depend on weights.
            add(x_g_hat, &row[latent..trunk_inputs.min(2 * latent)]);
        }
    }
}

impl<T: Element> PolicyDynamicsGradient<T> {
    /// `self += other`.
    pub fn add(&mut self, other: &Self) {
        let ours = [&mut self.trunk].into_iter().chain(&mut self.policy).chain(self.dynamics.iter_mut().flatten());
        let others = [&other.trunk].into_iter().chain(&other.policy).chain(other.dynamics.iter().flatten());
        ours.zip(others).for_each(|(ours, other)| ours.add(other));
        for (ours, other) in self.position.iter_mut().zip(&other.position) {
            add(ours, other);
        }
    }
}

/// Branches of a step in a double backward pass, with their orders.
#[derive(Debug, Clone, Copy)]
pub struct Branches {
    pub trunk: Order,
    /// `None` if nothing depends on the next state.
    pub dynamics: Option<Order>,
    /// True if the policy proposed the action; its pass is of the first order.
    pub policy: bool,
}

/// Gradients of Φ in a step's state, goal and action.
#[derive(Debug)]
pub struct Cotangents<'a, T> {
    /// x̂ `[R, Z]`.
    pub x: &'a mut [T],
    /// x̂_g `[R, Z]`.
    pub x_g: &'a mut [T],
    /// â `[R, A]`.
    pub action: &'a mut [T],
}
