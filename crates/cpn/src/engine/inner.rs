//! The inner loop: a rollout of g_θ, how far from the goal it ends, and the gradient of that in its actions.

use crate::engine::networks::policy_dynamics::{Buffers, PolicyDynamics, StepTape};
use crate::engine::simd::element::Element;

/// A rollout over a block of R samples.
#[derive(Debug)]
pub struct Rollout<T> {
    /// One for each of the H steps.
    pub steps: Vec<StepTape<T>>,
    /// x_H - x_g, `[R, Z]`.
    pub miss: Vec<T>,
    /// The inner loss' gradient in the actions, `[H, R, A]`.
    pub gradient: Vec<T>,
}

/// Where the actions of a rollout come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Actions {
    /// They are given.
    Given,
    /// They are those of the rollout before, moved down its loss: the first step sees the same state again.
    Moved,
    /// The policy proposes them along the way.
    Proposed,
}

/// What a rollout is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// The policy's actions; the state after the last is of no interest.
    Actions,
    /// The inner loss alone: the steps may share a tape, which stays in the caches.
    Loss,
    /// The inner loss, and its gradient afterwards.
    Gradient,
}

impl<T: Element> Rollout<T> {
    /// Room for H = `horizon` steps of blocks of up to `rows` samples.
    pub fn new(network: &PolicyDynamics<T>, rows: usize, horizon: usize) -> Self {
        Self {
            steps: (0..horizon).map(|_| network.tape(rows)).collect(),
            miss: vec![T::ZERO; rows * network.sizes.latent],
            gradient: vec![T::ZERO; horizon * rows * network.sizes.actions],
        }
    }

    /// Moves x, `[R, Z]`, along the actions, `[H, R, A]`, towards x_g, `[R, Z]`. Actions that are proposed are written
    /// there.
    pub fn forward(
        &mut self,
        network: &PolicyDynamics<T>,
        (x, x_g): (&mut [T], &[T]),
        (source, actions): (Actions, &mut [T]),
        purpose: Purpose,
        buffers: &mut Buffers<T>,
    ) {
        let rows = x.len() / network.sizes.latent;
        let horizon = self.steps.len();
        for (t, action) in actions.chunks_mut(rows * network.sizes.actions).take(horizon).enumerate() {
            let step = &mut self.steps[if purpose == Purpose::Loss { 0 } else { t }];
            if t > 0 || source != Actions::Moved {
                network.features(rows, step, x, x_g);
            }
            if source == Actions::Proposed {
                network.policy(rows, step, action);
            }
            if purpose != Purpose::Actions || t + 1 < horizon {
                network.next(rows, step, action, x, buffers);
            }
        }
        for (miss, (x, x_g)) in self.miss.iter_mut().zip(x.iter().zip(x_g)) {
            *miss = *x - *x_g;
        }
    }

    /// Leaves the gradient in the actions of the Huber loss (δ = 1) between x_H and x_g. `x_bar`, `[R, Z]`, is room for
    /// the adjoints of the states.
    pub fn backward(&mut self, network: &PolicyDynamics<T>, x_bar: &mut [T], buffers: &mut Buffers<T>) {
        let rows = x_bar.len() / network.sizes.latent;
        for (x_bar, miss) in x_bar.iter_mut().zip(&self.miss) {
            *x_bar = clamp(*miss);
        }
        let gradients = self.gradient.chunks_mut(rows * network.sizes.actions);
        for (t, (step, gradient)) in self.steps.iter_mut().zip(gradients).enumerate().rev() {
            network.vjp(rows, t == 0, step, x_bar, gradient, buffers);
        }
    }

    /// The inner loss of each of the R samples, summed over the latent.
    pub fn losses(&self, network: &PolicyDynamics<T>, rows: usize) -> impl Iterator<Item = T> {
        let half = T::ONE / (T::ONE + T::ONE);
        self.miss.chunks_exact(network.sizes.latent).take(rows).map(move |miss| {
            // |m| - 1/2 beyond 1, m²/2 within.
            miss.iter().map(|miss| clamp(*miss) * (*miss - half * clamp(*miss))).sum()
        })
    }
}

/// The derivative of the Huber loss with δ = 1.
pub fn clamp<T: Element>(x: T) -> T {
    if x > T::ONE {
        T::ONE
    } else if x < -T::ONE {
        -T::ONE
    } else {
        x
    }
}
