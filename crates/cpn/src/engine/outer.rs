//! The outer loop: behaviour cloning through the inner loop, and its gradient.

use super::simd::vector;
use crate::engine::layers::passes::Order;
use crate::engine::networks::policy_dynamics::{
    Branches, Buffers, Cotangents, PolicyDynamics, PolicyDynamicsGradient, Sizes,
};
use crate::engine::planning::rollout::{Actions, Purpose, Rollout, huber_grad};
use crate::engine::simd::element::Element;

/// What the rows of a batch are about.
#[derive(Debug, Clone, Copy)]
pub struct Samples<'a, T> {
    /// x, `[R, Z]`.
    pub x: &'a [T],
    /// x_g, `[R, Z]`.
    pub x_g: &'a [T],
    /// The demonstrated actions, `[R, H, A]`.
    pub actions: &'a [T],
    /// 1 where the demonstration has an action, else 0, `[R, H]`.
    pub mask: &'a [T],
}

/// The inner loop's settings.
#[derive(Debug, Clone, Copy)]
pub struct Settings<T> {
    /// H.
    pub horizon: usize,
    /// U.
    pub updates: usize,
    /// α.
    pub step_size: T,
    /// What the squared errors are multiplied by: 1 / (A Σ mask), the sum over the whole batch.
    pub scale: T,
}

/// Sums over the rows that were run.
#[derive(Debug)]
pub struct Sums<T> {
    /// The outer loss.
    pub loss: T,
    /// Its gradient in α.
    pub step_size: T,
    /// And in g_θ.
    pub network: PolicyDynamicsGradient<T>,
}

/// Tapes for a block of rows.
#[derive(Debug)]
pub struct Workspace<T> {
    /// A rollout before each update; one if there is none.
    rollouts: Vec<Rollout<T>>,
    buffers: Buffers<T>,
    /// By step, then row, `[H, R, A]`.
    actions: Vec<T>,
    /// Likewise: the outer loss' gradient in the actions.
    actions_hat: Vec<T>,
    actions_dot: Vec<T>,
    /// x along the rollout, then x̄, ẋ or x̂, `[R, Z]`.
    x: Vec<T>,
    x_hat: Vec<T>,
}

impl<'a, T: Element> Samples<'a, T> {
    /// How many, with Z.
    pub fn rows(&self, latent: usize) -> usize {
        self.x.len() / latent
    }

    /// Some of them, with Z.
    pub fn part(&self, latent: usize, first: usize, count: usize) -> Self {
        let rows = self.rows(latent);
        let cut = |values: &'a [T]| {
            let columns = values.len() / rows;
            &values[first * columns..(first + count) * columns]
        };
        Self { x: cut(self.x), x_g: cut(self.x_g), actions: cut(self.actions), mask: cut(self.mask) }
    }
}

impl<T: Element> Sums<T> {
    /// Sums of nothing.
    pub fn zeros(network: &PolicyDynamics<T>) -> Self {
        Self { loss: T::ZERO, step_size: T::ZERO, network: network.gradient() }
    }

    /// Adds those of other rows.
    pub fn add(&mut self, other: &Self) {
        self.loss += other.loss;
        self.step_size += other.step_size;
        self.network.add(&other.network);
    }

    /// The gradient by the names of the weights, that in α if it takes part.
    pub fn in_weights(&self, network: &PolicyDynamics<T>, with_step_size: bool) -> Vec<(String, Vec<T>)> {
        let weights = network.in_weights(&self.network).into_iter();
        let mut weights: Vec<_> = weights.map(|(name, weight)| (format!("network.{name}"), weight)).collect();
        if with_step_size {
            weights.push(("step_size".to_owned(), vec![self.step_size]));
        }
        weights
    }
}

impl<T: Element> Workspace<T> {
    /// Room for blocks of up to `rows` samples.
    pub fn new(network: &PolicyDynamics<T>, rows: usize, horizon: usize, updates: usize) -> Self {
        let Sizes { latent, actions, .. } = network.sizes;
        let zeros = |columns: usize| vec![T::ZERO; rows * columns];
        Self {
            rollouts: (0..updates.max(1)).map(|_| Rollout::new(network, rows, horizon)).collect(),
            buffers: network.buffers(rows),
            actions: zeros(horizon * actions),
            actions_hat: zeros(horizon * actions),
            actions_dot: zeros(horizon * actions),
            x: zeros(latent),
            x_hat: zeros(latent),
        }
    }

    /// Plans from each row's x towards its x_g, compares with the demonstration, and goes all the way back. Adds to `sums`;
    /// writes x̂ and x̂_g, the loss' gradients in x and x_g, `[R, Z]`.
    pub fn run(
        &mut self,
        network: &PolicyDynamics<T>,
        settings: Settings<T>,
        samples: Samples<'_, T>,
        (x_hat, x_g_hat): (&mut [T], &mut [T]),
        sums: &mut Sums<T>,
    ) {
        let rows = samples.x.len() / network.sizes.latent;
        x_hat.fill(T::ZERO);
        x_g_hat.fill(T::ZERO);
        for k in 0..self.rollouts.len() {
            self.roll_out(network, settings, samples, k);
            if settings.updates > 0 {
                self.update(network, settings, rows, k);
            }
        }
        sums.loss += self.compare(network.sizes, settings, samples, rows);
        for k in (0..self.rollouts.len()).rev() {
            if settings.updates > 0 {
                sums.step_size -= self.step_size_hat(network.sizes, rows, k);
                self.tangents(network, settings, rows, k, x_g_hat);
            } else {
                self.x_hat[..x_hat.len()].fill(T::ZERO);
            }
            self.adjoints(network, settings, rows, k, x_g_hat, &mut sums.network);
            vector::add(x_hat, &self.x_hat[..x_hat.len()]);
        }
    }

    /// Rollout k: along the policy's actions if it is the first, along the plan's otherwise.
    fn roll_out(&mut self, network: &PolicyDynamics<T>, settings: Settings<T>, samples: Samples<'_, T>, k: usize) {
        let Self { rollouts, buffers, actions, x, .. } = self;
        let x = &mut x[..samples.x.len()];
        x.copy_from_slice(samples.x);
        let source = if k == 0 { Actions::Proposed } else { Actions::Given };
        let purpose = if settings.updates > 0 { Purpose::Gradient } else { Purpose::Actions };
        rollouts[k].forward(network, (x, samples.x_g), (source, actions), purpose, buffers);
    }

    /// Update k of the actions: a step down the inner loss, by its gradient in the actions.
    fn update(&mut self, network: &PolicyDynamics<T>, settings: Settings<T>, rows: usize, k: usize) {
        let Self { rollouts, buffers, actions, x, .. } = self;
        rollouts[k].vjp(network, &mut x[..rows * network.sizes.latent], buffers);
        let size = settings.horizon * rows * network.sizes.actions;
        for (action, gradient) in actions.iter_mut().zip(&rollouts[k].gradient[..size]) {
            *action -= settings.step_size * *gradient;
        }
    }

    /// The outer loss; leaves its gradient in the planned actions.
    fn compare(&mut self, sizes: Sizes, settings: Settings<T>, samples: Samples<'_, T>, rows: usize) -> T {
        let mut loss = T::ZERO;
        for t in 0..settings.horizon {
            for r in 0..rows {
                let (at, demonstrated) = ((t * rows + r) * sizes.actions, (r * settings.horizon + t) * sizes.actions);
                let scale = samples.mask[r * settings.horizon + t] * settings.scale;
                for i in 0..sizes.actions {
                    let error = self.actions[at + i] - samples.actions[demonstrated + i];
                    loss += scale * error * error;
                    self.actions_hat[at + i] = (scale + scale) * error;
                }
            }
        }
        loss
    }

    /// How the loss falls with α in update k.
    fn step_size_hat(&self, sizes: Sizes, rows: usize, k: usize) -> T {
        let size = self.rollouts[k].steps.len() * rows * sizes.actions;
        self.actions_hat[..size].iter().zip(&self.rollouts[k].gradient).map(|(hat, gradient)| *hat * *gradient).sum()
    }

    /// Through update k, a ← a - α ∂L/∂a: the loss' derivative in ∂L/∂a is ȧ = -α â, and its derivative in whatever ∂L/∂a
    /// depends on is that of L's tangent along ȧ, whose passes begin here and end in [`Self::adjoints`].
    fn tangents(
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
        let (size, latents) = (rows * network.sizes.actions, rows * network.sizes.latent);
        let x_dot = &mut x[..latents];
        x_dot.fill(T::ZERO);
        for (t, step) in steps.iter_mut().enumerate() {
            network.jvp(rows, t == 0, step, &actions_dot[t * size..][..size], x_dot, buffers);
        }
        // Where the Huber loss is quadratic.
        for (((x_hat, x_g_hat), x_dot), error) in x_hat.iter_mut().zip(x_g_hat).zip(x_dot).zip(goal_error) {
            *x_hat = if huber_grad(*error) == *error { *x_dot } else { T::ZERO };
            *x_g_hat -= *x_hat;
        }
    }

    /// Back along rollout k: from x̂_H to x̂_0, and to â before the update.
    fn adjoints(
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
                // The first step's x does not move with the actions.
                trunk: if t > 0 { order } else { Order::First },
                dynamics: settings.moves(t).then_some(order),
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
    /// Whether the state after step t matters: to the next step, or to the inner loss.
    fn moves(&self, t: usize) -> bool {
        self.updates > 0 || t + 1 < self.horizon
    }
}
