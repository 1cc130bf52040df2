//! Outer loop: behaviour cloning through the inner loop and the dynamics loss, with their gradient, for blocks of samples on
//! several threads.

use super::dynamics_loss::DynamicsLoss;
use super::samples::Samples;
use crate::config::ModelConfig;
use crate::engine::layers::linear::Weights;
use crate::engine::layers::passes::Order;
use crate::engine::networks::policy_dynamics::{
    Branches, Buffers, Context, Cotangents, PolicyDynamics, PolicyDynamicsGradient, Sizes,
};
use crate::engine::planning::rollout::{Rollout, huber_grad};
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::add;
use crate::recipe::Losses;
use crate::search::block::{Actions, Purpose};
use rayon::prelude::*;

/// Maximum R, the number of samples in a block: more read the weights less often, and fewer keep the passes' intermediates in
/// nearer caches.
const BLOCK: usize = 32;

/// The outer loop on several threads, with tapes that are reused from batch to batch.
#[derive(Debug)]
pub struct OuterLoop<T> {
    config: ModelConfig,
    losses: Losses,
    threads: Vec<ThreadState<T>>,
}

/// Memory of a thread.
#[derive(Debug, Default)]
struct ThreadState<T> {
    tapes: Option<BlockTapes<T>>,
    accumulators: Option<Accumulators<T>>,
}

/// The outer loss of a batch, with its gradients.
#[derive(Debug)]
pub struct OuterGradient<T> {
    /// The loss.
    pub loss: T,
    /// The gradient in x, `[B, Z]`.
    pub x: Vec<T>,
    /// The gradient in x_g, `[B, Z]`.
    pub x_g: Vec<T>,
    /// The gradient by the weights' names in a checkpoint, for weights that affect the loss.
    pub weights: Vec<(String, Vec<T>)>,
}

/// Settings of the inner loop and the loss.
#[derive(Debug, Clone, Copy)]
struct Settings<T> {
    /// H, the planning horizon.
    horizon: usize,
    /// U, the number of updates.
    updates: usize,
    /// α, the step size of the inner loop.
    step_size: T,
    /// Weight of a squared error of an action in a cloned plan: 1 / (A Σ mask) over the number of cloned plans, with the sum over
    /// the whole batch.
    cloning: T,
    /// True if the plans before the last update are cloned, too.
    every_update: bool,
    /// Weight of a squared error of a predicted state's element: that of the loss over their number, compared × Σ mask.
    dynamics: T,
}

/// Accumulated loss and gradients of a thread's samples.
#[derive(Debug)]
struct Accumulators<T> {
    /// The outer loss.
    loss: T,
    /// The gradient in α.
    step_size: T,
    /// The gradient in g_θ.
    network: PolicyDynamicsGradient<T>,
}

/// Tapes and intermediates of a block of R samples.
#[derive(Debug)]
struct BlockTapes<T> {
    /// Rollouts before the updates; one for U = 0.
    rollouts: Vec<Rollout<T>>,
    buffers: Buffers<T>,
    /// Actions, `[H, R, A]`.
    actions: Vec<T>,
    /// Gradient of the outer loss in the actions, `[H, R, A]`.
    actions_hat: Vec<T>,
    actions_dot: Vec<T>,
    /// Gradients of the cloning losses of the plans before the updates, `[H, R, A]` each.
    cloning_hat: Vec<Vec<T>>,
    /// Made for the first batch with a dynamics loss.
    dynamics: Option<DynamicsLoss<T>>,
    /// x along the rollout, then x̄, ẋ or x̂, `[R, Z]`.
    x: Vec<T>,
    x_hat: Vec<T>,
}

impl<T: Element> OuterLoop<T> {
    /// An outer loop for models with a valid configuration, on `threads` threads, at least one.
    pub fn new(config: ModelConfig, losses: Losses, threads: usize) -> Self {
        let state = || ThreadState { tapes: None, accumulators: None };
        Self { config, losses, threads: (0..threads.max(1)).map(|_| state()).collect() }
    }

    /// The outer loss of a batch and its gradient, deterministic for a given number of threads.
    pub fn run(&mut self, weights: &impl Weights<T>, samples: Samples<'_, T>) -> OuterGradient<T> {
        let network = PolicyDynamics::new(&self.config, weights);
        let (horizon, updates) = (self.config.horizon as usize, self.config.trained_updates() as usize);
        debug_assert!(updates == 0 || network.position.is_none(), "position dynamics are not trained through updates");
        let count: T = samples.mask.iter().copied().sum();
        let cloned_plans = if self.losses.every_update { updates + 1 } else { 1 };
        let settings = Settings {
            horizon,
            updates,
            step_size: weights.get("step_size")[0],
            cloning: T::ONE / (count * T::count(network.sizes.actions) * T::count(cloned_plans)),
            every_update: self.losses.every_update,
            dynamics: T::from_f64(self.losses.dynamics) / (count * T::count(network.sizes.compared)),
        };

        // Each thread computes its share of the samples in blocks.
        let latent = network.sizes.latent;
        let (mut x, mut x_g) = (vec![T::ZERO; samples.x.len()], vec![T::ZERO; samples.x.len()]);
        let share = samples.rows(latent).div_ceil(self.threads.len());
        let shares = x.par_chunks_mut(share * latent).zip(x_g.par_chunks_mut(share * latent));
        self.threads.par_iter_mut().zip(shares).enumerate().for_each(|(i, (thread, (x, x_g)))| {
            let accumulators = thread.accumulators.insert(Accumulators::zeros(&network));
            let tapes = thread.tapes.get_or_insert_with(|| BlockTapes::new(&network, BLOCK, horizon, updates));
            let blocks = x.chunks_mut(BLOCK * latent).zip(x_g.chunks_mut(BLOCK * latent));
            for (block, (x, x_g)) in blocks.enumerate() {
                let first = i * share + block * BLOCK;
                let samples = samples.part(latent, first, x.len() / latent);
                tapes.run(&network, settings, samples, (x, x_g), accumulators);
            }
        });

        // The sum over the threads, in a fixed order.
        let mut parts = self.threads.iter_mut().filter_map(|thread| thread.accumulators.take());
        let mut total = parts.next().unwrap_or_else(|| Accumulators::zeros(&network));
        parts.for_each(|part| total.add(&part));
        OuterGradient { loss: total.loss, x, x_g, weights: total.in_weights(&network, updates > 0) }
    }
}

impl<T: Element> Accumulators<T> {
    /// Zero loss and gradients.
    fn zeros(network: &PolicyDynamics<T>) -> Self {
        Self { loss: T::ZERO, step_size: T::ZERO, network: network.gradient() }
    }

    /// `self += other`.
    fn add(&mut self, other: &Self) {
        self.loss += other.loss;
        self.step_size += other.step_size;
        self.network.add(&other.network);
    }

    /// The gradient by the weights' names in a checkpoint, with α for U > 0.
    fn in_weights(&self, network: &PolicyDynamics<T>, with_step_size: bool) -> Vec<(String, Vec<T>)> {
        let weights = network.in_weights(&self.network).into_iter();
        let mut weights: Vec<_> = weights.map(|(name, weight)| (format!("network.{name}"), weight)).collect();
        if with_step_size {
            weights.push(("step_size".to_owned(), vec![self.step_size]));
        }
        weights
    }
}

impl<T: Element> BlockTapes<T> {
    /// Tapes for blocks of up to R = `rows` samples.
    fn new(network: &PolicyDynamics<T>, rows: usize, horizon: usize, updates: usize) -> Self {
        let Sizes { latent, actions, .. } = network.sizes;
        let zeros = |columns: usize| vec![T::ZERO; rows * columns];
        Self {
            rollouts: (0..updates.max(1)).map(|_| Rollout::new(network, rows, horizon)).collect(),
            buffers: network.buffers(rows),
            actions: zeros(horizon * actions),
            actions_hat: zeros(horizon * actions),
            actions_dot: zeros(horizon * actions),
            cloning_hat: (0..updates).map(|_| zeros(horizon * actions)).collect(),
            dynamics: None,
            x: zeros(latent),
            x_hat: zeros(latent),
        }
    }

    /// The outer loss of a block, forward and backward: adds to `accumulators`, and writes x̂ and x̂_g, the gradients in x and x_g,
    /// `[R, Z]`.
    fn run(
        &mut self,
        network: &PolicyDynamics<T>,
        settings: Settings<T>,
        samples: Samples<'_, T>,
        (x_hat, x_g_hat): (&mut [T], &mut [T]),
        accumulators: &mut Accumulators<T>,
    ) {
        let rows = samples.x.len() / network.sizes.latent;
        x_hat.fill(T::ZERO);
        x_g_hat.fill(T::ZERO);

        // The inner loop, and the outer loss of its plans.
        for k in 0..self.rollouts.len() {
            self.roll_out(network, settings, samples, k);
            if settings.updates > 0 {
                if settings.every_update {
                    let (plan, hat) = (&self.actions, &mut self.cloning_hat[k]);
                    accumulators.loss += behaviour_cloning_loss(network.sizes, settings, samples, plan, hat);
                }
                self.update(network, settings, rows, k);
            }
        }
        let (plan, hat) = (&self.actions, &mut self.actions_hat);
        accumulators.loss += behaviour_cloning_loss(network.sizes, settings, samples, plan, hat);

        // Backward through the updates and their rollouts.
        for k in (0..self.rollouts.len()).rev() {
            if settings.updates > 0 {
                accumulators.step_size -= self.step_size_hat(network.sizes, rows, k);
                self.begin_update_backward(network, settings, rows, k, x_g_hat);
                if settings.every_update {
                    add(&mut self.actions_hat, &self.cloning_hat[k]);
                }
            } else {
                self.x_hat[..x_hat.len()].fill(T::ZERO);
            }
            self.rollout_backward(network, settings, rows, k, x_g_hat, &mut accumulators.network);
            add(x_hat, &self.x_hat[..x_hat.len()]);
        }

        if !samples.next.is_empty() {
            let dynamics = self.dynamics.get_or_insert_with(|| DynamicsLoss::new(network, BLOCK, settings.horizon));
            accumulators.loss +=
                dynamics.run(network, settings.dynamics, samples, (x_hat, x_g_hat), &mut accumulators.network);
        }
    }

    /// Rollout k: the first along the policy's actions, the others along the updated ones.
    fn roll_out(&mut self, network: &PolicyDynamics<T>, settings: Settings<T>, samples: Samples<'_, T>, k: usize) {
        let Self { rollouts, buffers, actions, x, .. } = self;
        let x = &mut x[..samples.x.len()];
        x.copy_from_slice(samples.x);
        let source = if k == 0 { Actions::Proposed } else { Actions::Given };
        let purpose = if settings.updates > 0 { Purpose::Gradient } else { Purpose::Actions };
        let context = Context { x_g: samples.x_g, steps_left: samples.steps_left };
        rollouts[k].forward(network, (x, context), (source, actions), purpose, buffers);
    }

    /// Update k of the actions: a gradient step on the inner loss.
    fn update(&mut self, network: &PolicyDynamics<T>, settings: Settings<T>, rows: usize, k: usize) {
        let Self { rollouts, buffers, actions, x, .. } = self;
        rollouts[k].vjp(network, &mut x[..rows * network.sizes.latent], buffers);
        let size = settings.horizon * rows * network.sizes.actions;
        for (action, gradient) in actions.iter_mut().zip(&rollouts[k].gradient[..size]) {
            *action -= settings.step_size * *gradient;
        }
    }

    /// The negative derivative of the outer loss in α of update k: Σ â ∂L/∂a, with the inner loss L.
    fn step_size_hat(&self, sizes: Sizes, rows: usize, k: usize) -> T {
        let size = self.rollouts[k].steps.len() * rows * sizes.actions;
        self.actions_hat[..size].iter().zip(&self.rollouts[k].gradient).map(|(hat, gradient)| *hat * *gradient).sum()
    }

    /// The first half of the backward pass of update k, a ← a - α ∂L/∂a: the gradient in ∂L/∂a is ȧ = -α â, so that the gradients
    /// in the arguments of ∂L/∂a are those of the tangent of L along ȧ. Computes the tangent pass, and x̂ at the end of the
    /// rollout, for [`Self::rollout_backward`].
    fn begin_update_backward(
        &mut self,
        network: &PolicyDynamics<T>,
        settings: Settings<T>,
        rows: usize,
        k: usize,
        x_g_hat: &mut [T],
    ) {
        let Self { rollouts, buffers, actions_hat, actions_dot, x, x_hat, .. } = self;
        let Rollout { steps, goal_error, .. } = &mut rollouts[k];
        for (dot, hat) in actions_dot.iter_mut().zip(&*actions_hat) {
            *dot = -settings.step_size * *hat;
        }

        // The tangent of the rollout along ȧ.
        let (size, latents) = (rows * network.sizes.actions, rows * network.sizes.latent);
        let x_dot = &mut x[..latents];
        x_dot.fill(T::ZERO);
        for (t, step) in steps.iter_mut().enumerate() {
            network.jvp(rows, t == 0, step, &actions_dot[t * size..][..size], x_dot, buffers);
        }

        // The second derivative of the Huber loss: 1 where it is quadratic, else 0.
        for (((x_hat, x_g_hat), x_dot), error) in x_hat.iter_mut().zip(x_g_hat).zip(x_dot).zip(goal_error) {
            *x_hat = if huber_grad(*error) == *error { *x_dot } else { T::ZERO };
            *x_g_hat -= *x_hat;
        }
    }

    /// Backward pass of rollout k: from x̂_H to x̂_0, and to â before the update.
    fn rollout_backward(
        &mut self,
        network: &PolicyDynamics<T>,
        settings: Settings<T>,
        rows: usize,
        k: usize,
        x_g_hat: &mut [T],
        gradient: &mut PolicyDynamicsGradient<T>,
    ) {
        let Self { rollouts, buffers, actions_hat, x_hat, .. } = self;
        let size = rows * network.sizes.actions;
        let order = if settings.updates > 0 { Order::Second } else { Order::First };
        for (t, step) in rollouts[k].steps.iter_mut().enumerate().rev() {
            let branches = Branches {
                // The first step's x does not depend on the actions.
                trunk: if t > 0 { order } else { Order::First },
                dynamics: settings.is_state_needed(t).then_some(order),
                policy: k == 0,
            };
            let mut hat = Cotangents {
                x: &mut x_hat[..rows * network.sizes.latent],
                x_g: x_g_hat,
                action: &mut actions_hat[t * size..][..size],
            };
            network.double_backward(rows, branches, step, &mut hat, gradient, buffers);
        }
    }
}

impl<T> Settings<T> {
    /// True if the next step or the inner loss depends on the state after step t.
    fn is_state_needed(&self, t: usize) -> bool {
        self.updates > 0 || t + 1 < self.horizon
    }
}

/// The loss of a cloned plan, `[H, R, A]`, the mean squared error of its actions; writes its gradient in them to `hat`.
fn behaviour_cloning_loss<T: Element>(
    sizes: Sizes,
    settings: Settings<T>,
    samples: Samples<'_, T>,
    plan: &[T],
    hat: &mut [T],
) -> T {
    let (horizon, rows) = (settings.horizon, samples.rows(sizes.latent));
    let mut loss = T::ZERO;
    for t in 0..horizon {
        for r in 0..rows {
            let (at, demonstrated) = ((t * rows + r) * sizes.actions, (r * horizon + t) * sizes.actions);
            let scale = samples.mask[r * horizon + t] * settings.cloning;
            for i in 0..sizes.actions {
                let error = plan[at + i] - samples.actions[demonstrated + i];
                loss += scale * error * error;
                hat[at + i] = (scale + scale) * error;
            }
        }
    }
    loss
}
