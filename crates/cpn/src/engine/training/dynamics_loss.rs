//! Dynamics loss of a block of samples: g_θ's predicted states under the applied actions against the embeddings of the frames
//! that followed.

use super::samples::Samples;
use crate::engine::layers::passes::Order;
use crate::engine::networks::policy_dynamics::{
    Branches, Buffers, Context, Cotangents, PolicyDynamics, PolicyDynamicsGradient, Sizes, StepTape,
};
use crate::engine::simd::element::Element;
use crate::engine::simd::vector::add;

/// Tapes and intermediates of a block of R samples.
#[derive(Debug)]
pub struct DynamicsLoss<T> {
    /// Tapes of the H steps.
    steps: Vec<StepTape<T>>,
    buffers: Buffers<T>,
    /// Applied actions of a step, then their gradient, which is not used, `[R, A]`.
    action: Vec<T>,
    /// Gradients of the loss in the predicted states, `[H, R, Z]`; 0 in elements that are not compared.
    state_hat: Vec<T>,
    /// x along the rollout, then x̂, `[R, Z]`.
    x: Vec<T>,
}

impl<T: Element> DynamicsLoss<T> {
    /// The loss of blocks of up to R = `rows` samples, over H = `horizon` steps.
    pub fn new(network: &PolicyDynamics<T>, rows: usize, horizon: usize) -> Self {
        let zeros = |columns: usize| vec![T::ZERO; rows * columns];
        Self {
            steps: (0..horizon).map(|_| network.tape(rows)).collect(),
            buffers: network.buffers(rows),
            action: zeros(network.sizes.actions),
            state_hat: zeros(horizon * network.sizes.latent),
            x: zeros(network.sizes.latent),
        }
    }

    /// The loss of a block, forward and backward: adds its gradients in x and x_g, `[R, Z]`, and in the weights. `scale` is the
    /// weight of an element's squared error.
    pub fn run(
        &mut self,
        network: &PolicyDynamics<T>,
        scale: T,
        samples: Samples<'_, T>,
        (x_hat, x_g_hat): (&mut [T], &mut [T]),
        gradient: &mut PolicyDynamicsGradient<T>,
    ) -> T {
        let (horizon, Sizes { latent, compared, actions, .. }) = (self.steps.len(), network.sizes);
        let rows = samples.rows(latent);
        let applied = |t: usize, r: usize| &samples.applied_actions[(r * horizon + t) * actions..][..actions];
        let Self { steps, buffers, action, state_hat, x } = self;
        let (x, action) = (&mut x[..rows * latent], &mut action[..rows * actions]);
        let context = Context { x_g: samples.x_g, steps_left: samples.steps_left };

        x.copy_from_slice(samples.x);
        let mut loss = T::ZERO;
        for (t, (step, hat)) in steps.iter_mut().zip(state_hat.chunks_mut(rows * latent)).enumerate() {
            for (r, action) in action.chunks_exact_mut(actions).enumerate() {
                action.copy_from_slice(applied(t, r));
            }
            match &network.position {
                Some(position) => position.next(action, x),
                None => {
                    network.features(rows, step, x, context);
                    network.next(rows, step, action, x, buffers);
                }
            }
            for r in 0..rows {
                let scale = samples.mask[r * horizon + t] * scale;
                let target = &samples.next[(r * horizon + t) * latent..][..compared];
                for (i, target) in target.iter().enumerate() {
                    let error = x[r * latent + i] - *target;
                    loss += scale * error * error;
                    hat[r * latent + i] = (scale + scale) * error;
                }
            }
        }

        x.fill(T::ZERO);
        let branches = Branches { trunk: Order::First, dynamics: Some(Order::First), policy: false };
        for (t, (step, state_hat)) in steps.iter_mut().zip(state_hat.chunks(rows * latent)).enumerate().rev() {
            add(x, state_hat);
            if let (Some(position), Some(gradient)) = (&network.position, &mut gradient.position) {
                position.accumulate((0..rows).map(|r| applied(t, r)), x, gradient);
            } else {
                let mut hat = Cotangents { x, x_g: x_g_hat, action };
                network.double_backward(rows, branches, step, &mut hat, gradient, buffers);
            }
        }
        add(x_hat, x);
        loss
    }
}
