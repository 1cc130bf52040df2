//! Memory of a planning thread.

use super::rollout::Rollout;
use crate::config::ModelConfig;
use crate::engine::layers::linear::Weights;
use crate::engine::networks::encoder::EncoderTape;
use crate::engine::networks::policy_dynamics::{Buffers, Context, PolicyDynamics};
use crate::engine::simd::element::Element;
use crate::search::Query;
use crate::search::block::{Actions, PlanBlock, Purpose};
use crate::steps_left;
use std::sync::Arc;

/// Maximum R, the number of plans in a block: more read the weights less often, and fewer keep the passes' intermediates in nearer
/// caches.
pub const BLOCK: usize = 16;

/// g_θ with the settings of its inner loop.
#[derive(Debug)]
pub struct Dynamics<T> {
    pub network: PolicyDynamics<T>,
    /// α, the step size of the inner loop.
    pub step_size: T,
    /// H, the planning horizon.
    pub horizon: usize,
    /// True if the method plans, false for a policy.
    pub plans: bool,
}

/// Memory of a thread: a block of plans, and the tapes of its passes.
#[derive(Debug)]
pub struct Worker<T: Element> {
    pub tape: EncoderTape<T>,
    dynamics: Arc<Dynamics<T>>,
    rollout: Rollout<T>,
    buffers: Buffers<T>,
    /// x along a rollout, then x̄, `[R, Z]`.
    x: Vec<T>,
    /// `[R, Z]`.
    x_g: Vec<T>,
    /// k, `[R]`.
    steps_left: Vec<T>,
    /// Actions, `[H, R, A]`.
    actions: Vec<T>,
    /// Identity of the descent of the last rollout.
    resident: Option<u64>,
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
    pub fn new(dynamics: Arc<Dynamics<T>>) -> Self {
        let sizes = dynamics.network.sizes;
        let zeros = |columns: usize| vec![T::ZERO; BLOCK * columns];
        Self {
            tape: EncoderTape::new(),
            rollout: Rollout::new(&dynamics.network, BLOCK, dynamics.horizon),
            buffers: dynamics.network.buffers(BLOCK),
            x: zeros(sizes.latent),
            x_g: zeros(sizes.latent),
            steps_left: zeros(1),
            actions: zeros(dynamics.horizon * sizes.actions),
            resident: None,
            dynamics,
        }
    }

    /// Index of action t, `[A]`, of plan r of R = `rows`.
    fn offset(&self, rows: usize, t: usize, r: usize) -> usize {
        (t * rows + r) * self.dynamics.network.sizes.actions
    }
}

impl PlanBlock for Worker<f32> {
    fn capacity(&self) -> usize {
        BLOCK
    }

    fn is_searchable(&self) -> bool {
        self.dynamics.plans
    }

    fn resident(&mut self) -> &mut Option<u64> {
        &mut self.resident
    }

    fn plan(&self, rows: usize, r: usize) -> Vec<Vec<f32>> {
        let size = self.dynamics.network.sizes.actions;
        (0..self.dynamics.horizon).map(|t| self.actions[self.offset(rows, t, r)..][..size].to_vec()).collect()
    }

    fn set_plan(&mut self, rows: usize, r: usize, plan: &[Vec<f32>]) {
        self.resident = None;
        for (t, action) in plan.iter().enumerate() {
            let offset = self.offset(rows, t, r);
            self.actions[offset..][..action.len()].copy_from_slice(action);
        }
    }

    fn roll_out(&mut self, queries: &[Query<'_>], source: Actions, purpose: Purpose) -> Vec<f32> {
        let Self { dynamics, rollout, buffers, x, x_g, steps_left, actions, resident, .. } = self;
        let (network, latent) = (&dynamics.network, dynamics.network.sizes.latent);
        *resident = None;
        for (r, query) in queries.iter().enumerate() {
            x[r * latent..][..latent].copy_from_slice(query.x);
            x_g[r * latent..][..latent].copy_from_slice(query.x_g);
            steps_left[r] = steps_left::scaled(query.steps_left);
        }

        let rows = queries.len();
        let context = Context { x_g: &x_g[..rows * latent], steps_left };
        rollout.forward(network, (&mut x[..rows * latent], context), (source, actions), purpose, buffers);
        rollout.losses(network, rows).collect()
    }

    fn descend(&mut self, rows: usize) {
        let Self { dynamics, rollout, buffers, x, actions, .. } = self;
        let sizes = dynamics.network.sizes;
        rollout.vjp(&dynamics.network, &mut x[..rows * sizes.latent], buffers);
        let gradient = rollout.gradient[..dynamics.horizon * rows * sizes.actions].iter();
        for (action, gradient) in actions.iter_mut().zip(gradient) {
            *action -= dynamics.step_size * *gradient;
        }
    }
}
