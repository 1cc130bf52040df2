//! Position dynamics: motion of the position, the first P elements of a state, by an action.

use crate::config::ModelConfig;
use crate::engine::layers::linear::Weights;
use crate::engine::simd::element::Element;
use crate::positions;

/// P, the number of elements of a position.
const POSITION: usize = positions::SIZE as usize;

/// Linear motion of the positions in a block of states, with its passes.
#[derive(Debug)]
pub struct PositionDynamics<T> {
    /// `[P, A]`.
    weight: Vec<T>,
    /// Z, the size of a state.
    latent: usize,
    /// A, the number of actions.
    actions: usize,
}

impl<T: Element> PositionDynamics<T> {
    /// The dynamics of a valid configuration; `None` without position dynamics.
    pub fn new(config: &ModelConfig, weights: &impl Weights<T>) -> Option<Self> {
        config.position_dynamics.then(|| Self {
            weight: weights.get("network.position.weight"),
            latent: config.encoder.latent() as usize,
            actions: config.actions as usize,
        })
    }

    /// A zero gradient in the weight, `[P, A]`.
    pub fn gradient(&self) -> Vec<T> {
        vec![T::ZERO; self.weight.len()]
    }

    /// Moves the positions in the states x, `[R, Z]`, by an action, `[R, A]`, and leaves their other elements as they are.
    pub fn next(&self, action: &[T], x: &mut [T]) {
        for (x, action) in x.chunks_exact_mut(self.latent).zip(action.chunks_exact(self.actions)) {
            for (x, weight) in x.iter_mut().zip(self.weight.chunks_exact(self.actions)) {
                *x += weight.iter().zip(action).map(|(weight, action)| *weight * *action).sum();
            }
        }
    }

    /// Adds the gradient in the action, from x̄ of the next state, `[R, Z]`, to ā, `[R, A]`.
    pub fn vjp(&self, x_bar: &[T], action_bar: &mut [T]) {
        for (x_bar, action_bar) in x_bar.chunks_exact(self.latent).zip(action_bar.chunks_exact_mut(self.actions)) {
            for (x_bar, weight) in x_bar.iter().zip(self.weight.chunks_exact(self.actions)) {
                for (action_bar, weight) in action_bar.iter_mut().zip(weight) {
                    *action_bar += *x_bar * *weight;
                }
            }
        }
    }

    /// Adds to the gradient in the weight, `[P, A]`, from R actions, `[A]` each, and x̂ of the next state, `[R, Z]`.
    pub fn accumulate<'a>(&self, actions: impl Iterator<Item = &'a [T]>, x_hat: &[T], gradient: &mut [T]) {
        for (action, x_hat) in actions.zip(x_hat.chunks_exact(self.latent)) {
            for (x_hat, gradient) in x_hat.iter().zip(gradient.chunks_exact_mut(self.actions)) {
                for (gradient, action) in gradient.iter_mut().zip(action) {
                    *gradient += *x_hat * *action;
                }
            }
        }
    }

    /// Zeroes the positions in each of some states, or gradients in states, `[R, Z]`.
    pub fn clear(&self, x: &mut [T]) {
        x.chunks_exact_mut(self.latent).for_each(|x| x[..POSITION].fill(T::ZERO));
    }
}
