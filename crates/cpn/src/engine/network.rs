//! g_θ: the four passes over one step of a rollout.

use crate::config::ModelConfig;
use crate::engine::layers::dense::{Dense, DenseGradient, LayerTape};
use crate::engine::layers::linear::Weights;
use crate::engine::layers::neuromodulated::gated_weights::Scratch;
use crate::engine::layers::passes::Order;
use crate::engine::layers::relu::{relu, relu_mask};
use crate::engine::simd::buffer::{AlignedVec, zeros};
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::add;

/// The layers of both branches.
const POLICY: [&str; 2] = ["policy_0", "policy_1"];
const DYNAMICS: [&str; 2] = ["dynamics_0", "dynamics_1"];

/// The network's weights.
#[derive(Debug)]
pub struct Network<T> {
    trunk: Dense<T>,
    policy: [Dense<T>; 2],
    dynamics: Option<[Dense<T>; 2]>,
    pub sizes: Sizes,
}

/// How wide everything is.
#[derive(Debug, Clone, Copy)]
pub struct Sizes {
    /// Z.
    pub latent: usize,
    /// Of the trunk's features and the hidden layers.
    pub hidden: usize,
    /// A.
    pub actions: usize,
    /// What the trunk sees: x, and x_g if it is conditioned on the goal.
    pub seen: usize,
}

/// What a loss changes by when the network's weights do.
#[derive(Debug)]
pub struct NetworkGradient<T> {
    pub trunk: DenseGradient<T>,
    pub policy: [DenseGradient<T>; 2],
    pub dynamics: Option<[DenseGradient<T>; 2]>,
}

/// What the passes over a step leave for each other.
#[derive(Debug)]
pub struct Step<T> {
    trunk: LayerTape<T>,
    policy: [LayerTape<T>; 2],
    dynamics: Option<[LayerTape<T>; 2]>,
    /// The trunk's features `[R, hidden]`.
    features: AlignedVec<T>,
    /// What the policy proposed, `[R, A]`.
    proposed: AlignedVec<T>,
}

/// Room that no pass needs beyond its end.
#[derive(Debug)]
pub struct Buffers<T> {
    gates: Scratch<T>,
    /// Features with the action, or what the trunk sees.
    wide: AlignedVec<T>,
    narrow: AlignedVec<T>,
}

impl<T: Element> Network<T> {
    /// Reads the weights of a model of this configuration.
    pub fn new(config: &ModelConfig, weights: &impl Weights<T>) -> Self {
        let method = config.method;
        let (latent, hidden) = (config.encoder.latent() as usize, config.hidden as usize);
        let layer = |name: &str, rectified| {
            Dense::named(&format!("network.{name}"), rectified, weights, method.is_neuromodulated())
        };
        let behind = |name: &str| layer(name, hidden);
        Self {
            trunk: layer("trunk", 0),
            policy: POLICY.map(behind),
            dynamics: method.plans().then(|| DYNAMICS.map(behind)),
            sizes: Sizes {
                latent,
                hidden,
                actions: config.actions as usize,
                seen: if method.is_goal_conditioned() { 2 * latent } else { latent },
            },
        }
    }

    /// A gradient of zeros.
    pub fn gradient(&self) -> NetworkGradient<T> {
        NetworkGradient {
            trunk: self.trunk.gradient(),
            policy: self.policy.each_ref().map(Dense::gradient),
            dynamics: self.dynamics.as_ref().map(|layers| layers.each_ref().map(Dense::gradient)),
        }
    }

    /// A gradient by the names of the weights, without `network.` before them.
    pub fn in_weights(&self, gradient: &NetworkGradient<T>) -> Vec<(String, Vec<T>)> {
        let mut weights = self.trunk.in_weights("trunk", &gradient.trunk);
        for ((name, layer), gradient) in POLICY.iter().zip(&self.policy).zip(&gradient.policy) {
            weights.extend(layer.in_weights(name, gradient));
        }
        let dynamics = self.dynamics.iter().flatten().zip(gradient.dynamics.iter().flatten());
        for (name, (layer, gradient)) in DYNAMICS.iter().zip(dynamics) {
            weights.extend(layer.in_weights(name, gradient));
        }
        weights
    }

    /// A step's tape for blocks of up to R = `rows` samples.
    pub fn step(&self, rows: usize) -> Step<T> {
        let tapes = |layers: &[Dense<T>; 2]| layers.each_ref().map(|layer| layer.tape(rows));
        Step {
            trunk: self.trunk.tape(rows),
            policy: tapes(&self.policy),
            dynamics: self.dynamics.as_ref().map(tapes),
            features: zeros(rows * self.sizes.hidden),
            proposed: zeros(rows * self.sizes.actions),
        }
    }

    /// Room for blocks of up to `rows` samples.
    pub fn buffers(&self, rows: usize) -> Buffers<T> {
        let Sizes { latent, hidden, actions, seen } = self.sizes;
        Buffers {
            gates: Scratch::new(),
            wide: zeros(rows * seen.max(hidden + actions)),
            narrow: zeros(rows * latent.max(hidden)),
        }
    }

    /// The trunk: leaves the features of x, `[R, Z]`, on the tape; x_g likewise.
    pub fn features(&self, rows: usize, step: &mut Step<T>, x: &[T], x_g: &[T]) {
        let Sizes { latent, seen, .. } = self.sizes;
        for (r, input) in step.trunk.x(rows).chunks_exact_mut(seen).enumerate() {
            let row = r * latent..(r + 1) * latent;
            input[..latent].copy_from_slice(&x[row.clone()]);
            if seen > latent {
                input[latent..].copy_from_slice(&x_g[row]);
            }
        }
        let features = &mut step.features[..rows * self.sizes.hidden];
        self.trunk.forward(rows, &mut step.trunk, features);
        relu(features);
    }

    /// The policy branch: an action, `[R, A]`, of the features on the tape.
    pub fn policy(&self, rows: usize, step: &mut Step<T>, action: &mut [T]) {
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

    /// The dynamics branch: moves x, `[R, Z]`, on by an action, `[R, A]`, with the features on the tape.
    pub fn next(&self, rows: usize, step: &mut Step<T>, action: &[T], x: &mut [T], buffers: &mut Buffers<T>) {
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
        add(x, change);
    }

    /// Turns x̄ after the step, `[R, Z]`, into x̄ before it, unless `is_first`, and answers ā, `[R, A]`.
    pub fn backward(
        &self,
        rows: usize,
        is_first: bool,
        step: &mut Step<T>,
        x_bar: &mut [T],
        action_bar: &mut [T],
        buffers: &mut Buffers<T>,
    ) {
        let Some((layers, [first, second])) = self.dynamics.as_ref().zip(step.dynamics.as_mut()) else { return };
        let Sizes { latent, hidden, actions, seen } = self.sizes;
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
        relu_mask(features_bar, &step.features);
        let wide = &mut buffers.wide[..rows * seen];
        wide.fill(T::ZERO);
        self.trunk.vjp(rows, &mut step.trunk, &mut buffers.gates, wide);
        for (x_bar, row) in x_bar.chunks_exact_mut(latent).zip(wide.chunks_exact(seen)) {
            add(x_bar, &row[..latent]);
        }
    }

    /// Moves ẋ, `[R, Z]`, on by ȧ, `[R, A]`. At the first step ẋ is 0.
    pub fn tangent(
        &self,
        rows: usize,
        is_first: bool,
        step: &mut Step<T>,
        action_dot: &[T],
        x_dot: &mut [T],
        buffers: &mut Buffers<T>,
    ) {
        let Some((layers, [first, second])) = self.dynamics.as_ref().zip(step.dynamics.as_mut()) else { return };
        let Sizes { latent, hidden, actions, seen } = self.sizes;
        let features_dot = &mut buffers.narrow[..rows * hidden];
        if is_first {
            features_dot.fill(T::ZERO);
        } else {
            for (input, x_dot) in step.trunk.x_dot(rows).chunks_exact_mut(seen).zip(x_dot.chunks_exact(latent)) {
                input[..latent].copy_from_slice(x_dot);
                input[latent..].fill(T::ZERO);
            }
            self.trunk.jvp(rows, &mut step.trunk, features_dot);
            relu_mask(features_dot, &step.features);
        }
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

    /// Turns x̂ after the step, `[R, Z]`, into x̂ before it; adds to x̂_g, to â, `[R, A]`, and to the gradient.
    pub fn adjoint(
        &self,
        rows: usize,
        parts: Parts,
        step: &mut Step<T>,
        hat: &mut Hat<'_, T>,
        gradient: &mut NetworkGradient<T>,
        buffers: &mut Buffers<T>,
    ) {
        let Sizes { latent, hidden, actions, seen } = self.sizes;
        let features_hat = &mut buffers.narrow[..rows * hidden];
        features_hat.fill(T::ZERO);
        let gates = &mut buffers.gates;
        if let (Some(order), Some(layers), Some([first, second]), Some(gradients)) =
            (parts.dynamics, &self.dynamics, &mut step.dynamics, &mut gradient.dynamics)
        {
            second.y_hat(rows).copy_from_slice(hat.x);
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
        }
        if parts.policy {
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
        relu_mask(features_hat, &step.features);
        step.trunk.y_hat(rows).copy_from_slice(features_hat);
        let wide = &mut buffers.wide[..rows * seen];
        wide.fill(T::ZERO);
        self.trunk.double_backward(rows, parts.trunk, &mut step.trunk, gates, wide, &mut gradient.trunk);
        let rows_of = hat.x.chunks_exact_mut(latent).zip(hat.x_g.chunks_exact_mut(latent));
        for ((x_hat, x_g_hat), row) in rows_of.zip(wide.chunks_exact(seen)) {
            add(x_hat, &row[..latent]);
            add(x_g_hat, &row[latent..]);
        }
    }
}

impl<T: Element> NetworkGradient<T> {
    /// Adds another.
    pub fn add(&mut self, other: &Self) {
        let ours = [&mut self.trunk].into_iter().chain(&mut self.policy).chain(self.dynamics.iter_mut().flatten());
        let others = [&other.trunk].into_iter().chain(&other.policy).chain(other.dynamics.iter().flatten());
        ours.zip(others).for_each(|(ours, other)| ours.add(other));
    }
}

/// Which parts of a step the outer loop differentiates through, and how often.
#[derive(Debug, Clone, Copy)]
pub struct Parts {
    pub trunk: Order,
    pub dynamics: Option<Order>,
    pub policy: bool,
}

/// Adjoints that go through a step.
#[derive(Debug)]
pub struct Hat<'a, T> {
    /// x̂ `[R, Z]`.
    pub x: &'a mut [T],
    /// x̂_g `[R, Z]`.
    pub x_g: &'a mut [T],
    /// â `[R, A]`.
    pub action: &'a mut [T],
}
