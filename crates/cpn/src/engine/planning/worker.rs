//! A thread's memory for plans, and the two steps that every search is made of: a rollout, and a step down its loss.

use super::rollout::{Actions, Purpose, Rollout};
use crate::config::ModelConfig;
use crate::engine::layers::linear::Weights;
use crate::engine::networks::encoder::EncoderTape;
use crate::engine::networks::policy_dynamics::{Buffers, PolicyDynamics};
use crate::engine::simd::element::Element;

/// R, the plans of a block: with more of them weights are read less often, with fewer the passes' intermediates lie nearer.
pub const BLOCK: usize = 16;

/// g_θ with the settings of its inner loop.
#[derive(Debug)]
pub struct Dynamics<T> {
    pub network: PolicyDynamics<T>,
    /// α.
    pub step_size: T,
    /// H.
    pub horizon: usize,
    /// True if there is a goal to plan towards, false if there is only a policy to ask.
    pub plans: bool,
}

/// One thread's memory.
#[derive(Debug)]
pub struct Worker<T: Element> {
    pub tape: EncoderTape<T>,
    rollout: Rollout<T>,
    buffers: Buffers<T>,
    /// x along a rollout, then x̄, `[R, Z]`.
    x: Vec<T>,
    /// `[R, Z]`.
    x_g: Vec<T>,
    /// Actions by step, then row, `[H, R, A]`.
    actions: Vec<T>,
    /// Identity of the descent that the last rollout belongs to.
    pub resident: Option<u64>,
}

impl<T: Element> Dynamics<T> {
    /// The network of a valid configuration.
    pub fn new(config: &ModelConfig, weights: &impl Weights<T>) -> Self {
        Self {
            network: PolicyDynamics::new(config, weights),
            step_size: weights.get("step_size")[0],
            horizon: config.horizon as usize,
            plans: config.method.plans(),
        }
    }
}

impl<T: Element> Worker<T> {
    /// Memory for blocks of up to [`BLOCK`] plans.
    pub fn new(dynamics: &Dynamics<T>) -> Self {
        let sizes = dynamics.network.sizes;
        let zeros = |columns: usize| vec![T::ZERO; BLOCK * columns];
        Self {
            tape: EncoderTape::new(),
            rollout: Rollout::new(&dynamics.network, BLOCK, dynamics.horizon),
            buffers: dynamics.network.buffers(BLOCK),
            x: zeros(sizes.latent),
            x_g: zeros(sizes.latent),
            actions: zeros(dynamics.horizon * sizes.actions),
            resident: None,
        }
    }

    /// Rolls out from x along the worker's actions, given or proposed by the policy; returns the inner losses. After a rollout for
    /// its loss alone there is nothing to descend by. `ends` are x and x_g, `[Z]` each, row by row.
    pub fn roll_out<'a>(
        &mut self,
        dynamics: &Dynamics<T>,
        (source, purpose): (Actions, Purpose),
        ends: impl Iterator<Item = (&'a [T], &'a [T])>,
    ) -> impl Iterator<Item = T> {
        let (network, latent) = (&dynamics.network, dynamics.network.sizes.latent);
        let Self { rollout, buffers, x, x_g, actions, resident, .. } = self;
        *resident = None;
        let mut rows = 0;
        for (from, to) in ends {
            x[rows * latent..][..latent].copy_from_slice(from);
            x_g[rows * latent..][..latent].copy_from_slice(to);
            rows += 1;
        }

        let ends = (&mut x[..rows * latent], &x_g[..rows * latent]);
        rollout.forward(network, ends, (source, actions), purpose, buffers);
        rollout.losses(network, rows)
    }

    /// Moves the actions of the rollout, of R = `rows` plans, a step down the inner loss.
    pub fn descend(&mut self, dynamics: &Dynamics<T>, rows: usize) {
        let sizes = dynamics.network.sizes;
        let Self { rollout, buffers, x, actions, .. } = self;
        rollout.vjp(&dynamics.network, &mut x[..rows * sizes.latent], buffers);
        for (action, gradient) in
            actions.iter_mut().zip(&rollout.gradient).take(dynamics.horizon * rows * sizes.actions)
        {
            *action -= dynamics.step_size * *gradient;
        }
    }

    /// Action t of plan r of R = `rows`, `[A]`.
    fn action(&mut self, dynamics: &Dynamics<T>, rows: usize, t: usize, r: usize) -> &mut [T] {
        let size = dynamics.network.sizes.actions;
        &mut self.actions[(t * rows + r) * size..][..size]
    }
}

impl Worker<f32> {
    /// The plan of row r of R = `rows`, `[H][A]`.
    pub fn plan(&mut self, dynamics: &Dynamics<f32>, rows: usize, r: usize) -> Vec<Vec<f32>> {
        (0..dynamics.horizon).map(|t| self.action(dynamics, rows, t, r).to_vec()).collect()
    }

    /// Writes a plan, `[H][A]`, as row r of R = `rows`.
    pub fn set_plan(&mut self, dynamics: &Dynamics<f32>, rows: usize, r: usize, plan: &[Vec<f32>]) {
        self.resident = None;
        for (t, action) in plan.iter().enumerate() {
            self.action(dynamics, rows, t, r).copy_from_slice(action);
        }
    }
}
