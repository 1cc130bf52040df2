//! Rollout of g_θ in the inner loop, with the inner loss and its gradient in the actions.

use crate::engine::networks::policy_dynamics::{Buffers, Context, PolicyDynamics, Sizes, StepTape};
use crate::engine::simd::element::Element;
use crate::search::block::{Actions, Purpose};

/// A rollout over a block of R samples.
#[derive(Debug)]
pub struct Rollout<T> {
    /// Tapes of the H steps.
    pub steps: Vec<StepTape<T>>,
    /// Goal error x_H - x_g, `[R, Z]`; 0 in elements that are not compared.
    pub goal_error: Vec<T>,
    /// Gradient of the inner loss in the actions, `[H, R, A]`.
    pub gradient: Vec<T>,
}

impl<T: Element> Rollout<T> {
    /// A rollout of H = `horizon` steps for blocks of up to R = `rows` samples.
    pub fn new(network: &PolicyDynamics<T>, rows: usize, horizon: usize) -> Self {
        Self {
            steps: (0..horizon).map(|_| network.tape(rows)).collect(),
            goal_error: vec![T::ZERO; rows * network.sizes.latent],
            gradient: vec![T::ZERO; horizon * rows * network.sizes.actions],
        }
    }

    /// Rolls out along the actions, `[H, R, A]`: replaces x, `[R, Z]`, by x_H, and sets the goal error to the context's
    /// x_g. Proposed actions are written to `actions`. For [`Purpose::Loss`] the steps share a tape, which stays in the caches.
    pub fn forward(
        &mut self,
        network: &PolicyDynamics<T>,
        (x, context): (&mut [T], Context<'_, T>),
        (source, actions): (Actions, &mut [T]),
        purpose: Purpose,
        buffers: &mut Buffers<T>,
    ) {
        let rows = x.len() / network.sizes.latent;
        let horizon = self.steps.len();
        for (t, action) in actions.chunks_mut(rows * network.sizes.actions).take(horizon).enumerate() {
            if let (Some(position), Actions::Given | Actions::Moved) = (&network.position, source) {
                // Only positions are compared, and nothing else of the states affects them.
                position.next(action, x);
                continue;
            }
            let step = &mut self.steps[if purpose == Purpose::Loss { 0 } else { t }];
            if t > 0 || source != Actions::Moved {
                network.features(rows, step, x, context);
            }
            if source == Actions::Proposed {
                network.policy(rows, step, action);
            }
            if purpose != Purpose::Actions || t + 1 < horizon {
                network.next(rows, step, action, x, buffers);
            }
        }

        let Sizes { latent, compared, .. } = network.sizes;
        let states = x.chunks_exact(latent).zip(context.x_g.chunks_exact(latent));
        for (error, (x, x_g)) in self.goal_error.chunks_exact_mut(latent).zip(states) {
            for (error, (x, x_g)) in error[..compared].iter_mut().zip(x.iter().zip(x_g)) {
                *error = *x - *x_g;
            }
        }
    }

    /// The gradient of the Huber loss (δ = 1) between the compared elements of x_H and x_g in the actions, written to
    /// [`Self::gradient`]. `x_bar`, `[R, Z]`, is a buffer for the gradients in the states.
    pub fn vjp(&mut self, network: &PolicyDynamics<T>, x_bar: &mut [T], buffers: &mut Buffers<T>) {
        let rows = x_bar.len() / network.sizes.latent;
        for (x_bar, error) in x_bar.iter_mut().zip(&self.goal_error) {
            *x_bar = huber_grad(*error);
        }

        let gradients = self.gradient.chunks_mut(rows * network.sizes.actions);
        if let Some(position) = &network.position {
            for gradient in gradients.take(self.steps.len()) {
                gradient.fill(T::ZERO);
                position.vjp(x_bar, gradient);
            }
            return;
        }
        for (t, (step, gradient)) in self.steps.iter_mut().zip(gradients).enumerate().rev() {
            network.vjp(rows, t == 0, step, x_bar, gradient, buffers);
        }
    }

    /// Inner losses, `[R]`, summed over the compared elements.
    pub fn losses(&self, network: &PolicyDynamics<T>, rows: usize) -> impl Iterator<Item = T> {
        self.goal_error.chunks_exact(network.sizes.latent).take(rows).map(huber_loss)
    }
}

/// The sum of Huber losses with δ = 1: |e| - 1/2 for |e| > 1, else e²/2.
fn huber_loss<T: Element>(errors: &[T]) -> T {
    let half = T::ONE / (T::ONE + T::ONE);
    errors.iter().map(|error| huber_grad(*error) * (*error - half * huber_grad(*error))).sum()
}

/// The derivative of the Huber loss with δ = 1: the error clamped to [-1, 1].
pub fn huber_grad<T: Element>(error: T) -> T {
    if error > T::ONE {
        T::ONE
    } else if error < -T::ONE {
        -T::ONE
    } else {
        error
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_loss_is_hubers_and_the_gradient_its_derivative() {
        for i in -30..=30 {
            let error = f64::from(i) * 0.1 + 0.03;
            let expected = if error.abs() > 1.0 { error.abs() - 0.5 } else { error * error / 2.0 };
            assert!((huber_loss(&[error]) - expected).abs() < 1e-12, "{error}");
            let difference = (huber_loss(&[error + 1e-6]) - huber_loss(&[error - 1e-6])) / 2e-6;
            assert!((huber_grad(error) - difference).abs() < 1e-6, "{error}");
        }
        assert_eq!(huber_loss(&[2.0, -3.0, 0.5]), 1.5 + 2.5 + 0.125);
        assert!(huber_grad(f64::NAN).is_nan());
    }
}
