//! Planner of libtorch's engine.

use crate::agent::Agent;
use crate::tensors;
use cpn::method::{Observed, Ongoing, Plan, Query, Search};
use cpn::search::Searcher;
use cpn::search::block::{Actions, PlanBlock, Purpose};
use cpn::{FamiliarGoals, Input, Method, Model, ModelConfig};
use tch::{Device, Kind, Tensor};

/// R on the processor. Smaller batches are padded: at the paper's sizes a plan then does not depend on the rest of the batch, at others
/// within rounding.
const CPU_ROWS: usize = 16;
/// R on a CUDA device, where the time hardly grows with the rows.
const CUDA_ROWS: usize = 256;

/// A learned method on a device of libtorch.
#[derive(Debug)]
pub struct TorchPlanner {
    config: ModelConfig,
    familiar: Option<FamiliarGoals>,
    searcher: Searcher<TorchBlock>,
}

/// A block of R plans.
#[derive(Debug)]
struct TorchBlock {
    agent: Agent,
    device: Device,
    threads: usize,
    /// R, the number of rows.
    capacity: usize,
    /// Actions, `[R, H, A]`.
    actions: Vec<f32>,
    /// Actions, `[R, H, A]`, and inner losses, `[R]`, of the last rollout, with their graph.
    rollout: Option<(Tensor, Tensor)>,
    /// Identity of the descent of the last rollout.
    resident: Option<u64>,
}

impl TorchPlanner {
    /// A planner of a valid model; `threads` applies to the processor.
    pub fn new(model: &Model, device: Device, threads: usize) -> Self {
        let mut agent = Agent::new(model, device);
        agent.variables_mut().freeze();
        let config = model.config.clone();
        let capacity = if device.is_cuda() { CUDA_ROWS } else { CPU_ROWS };
        let actions = vec![0.0; capacity * (config.horizon * config.actions) as usize];
        let block = TorchBlock { agent, device, threads, capacity, actions, rollout: None, resident: None };
        Self { config, familiar: model.familiar.clone(), searcher: Searcher::new(vec![block]) }
    }
}

impl Method for TorchPlanner {
    fn name(&self) -> &'static str {
        self.config.method.name()
    }

    fn horizon(&self) -> usize {
        self.config.horizon as usize
    }

    fn actions(&self) -> usize {
        self.config.actions as usize
    }

    fn updates(&self) -> Option<usize> {
        self.searcher.is_searchable().then_some(self.config.updates as usize)
    }

    fn takes(&self, input: Input) -> bool {
        self.config.encoder.input() == input
    }

    fn takes_steps_left(&self) -> bool {
        self.config.method.takes_steps_left()
    }

    fn encode(&mut self, inputs: &[Observed<'_>]) -> Vec<Vec<f32>> {
        let block = &self.searcher.blocks_mut()[0];
        inputs.chunks(block.capacity).flat_map(|inputs| block.encode(inputs)).collect()
    }

    fn is_familiar(&self, x_g: &[f32]) -> bool {
        self.familiar.as_ref().is_some_and(|familiar| familiar.contains(x_g))
    }

    fn moves_positions(&self) -> bool {
        self.config.position_dynamics
    }

    fn plan(&mut self, queries: &[Query<'_>], search: &mut Search<'_>) -> Vec<Plan> {
        self.searcher.plan(queries, search)
    }

    fn together(&self) -> usize {
        self.searcher.together()
    }

    fn resume(&mut self, queries: &[Query<'_>], ongoing: &mut Ongoing, go_on: &mut dyn FnMut() -> bool) {
        self.searcher.resume(queries, ongoing, go_on);
    }
}

impl TorchBlock {
    /// Embeddings, `[Z]` each, of at most R inputs.
    fn encode(&self, inputs: &[Observed<'_>]) -> Vec<Vec<f32>> {
        self.use_threads();
        let frames = self.padded(&tensors::from_observed(inputs));
        let embeddings = self.agent.encode(&frames).narrow(0, 0, inputs.len() as i64);
        let latent = embeddings.size()[1] as usize;
        tensors::to_floats(&embeddings).chunks_exact(latent).map(<[f32]>::to_vec).collect()
    }

    /// Rows on the device, padded with zeros to R.
    fn padded(&self, rows: &Tensor) -> Tensor {
        let missing = self.capacity as i64 - rows.size()[0];
        let mut padding = vec![0; 2 * rows.dim()];
        // Pairs of padding before and after each dimension, from the last dimension to the first.
        if let Some(after) = padding.last_mut() {
            *after = missing;
        }
        rows.to_device(self.device).constant_pad_nd(padding)
    }

    /// `count` embeddings, `[Z]` each, as `[R, Z]` on the device.
    fn stacked<'a>(&self, embeddings: impl Iterator<Item = &'a [f32]>, count: usize) -> Tensor {
        let rows: Vec<f32> = embeddings.flatten().copied().collect();
        self.padded(&Tensor::from_slice(&rows).view([count as i64, -1]))
    }

    /// Sets libtorch's number of threads, a setting of the calling thread.
    fn use_threads(&self) {
        if !self.device.is_cuda() {
            tch::set_num_threads(self.threads as i32);
        }
    }

    /// Number of elements of a plan, H A.
    fn plan_size(&self) -> usize {
        self.actions.len() / self.capacity
    }
}

impl PlanBlock for TorchBlock {
    fn capacity(&self) -> usize {
        self.capacity
    }

    fn is_searchable(&self) -> bool {
        self.agent.config().method.plans()
    }

    fn resident(&mut self) -> &mut Option<u64> {
        &mut self.resident
    }

    fn plan(&self, _rows: usize, r: usize) -> Vec<Vec<f32>> {
        let (size, action) = (self.plan_size(), self.agent.config().actions as usize);
        self.actions[r * size..][..size].chunks_exact(action).map(<[f32]>::to_vec).collect()
    }

    fn set_plan(&mut self, _rows: usize, r: usize, plan: &[Vec<f32>]) {
        self.resident = None;
        let size = self.plan_size();
        for (number, value) in self.actions[r * size..].iter_mut().zip(plan.iter().flatten()) {
            *number = *value;
        }
    }

    fn roll_out(&mut self, queries: &[Query<'_>], source: Actions, purpose: Purpose) -> Vec<f32> {
        let _no_grad = tch::no_grad_guard();
        self.use_threads();
        (self.resident, self.rollout) = (None, None);
        let rows = queries.len();
        let x = self.stacked(queries.iter().map(|query| query.x), rows);
        let x_g = self.stacked(queries.iter().map(|query| query.x_g), rows);
        if purpose == Purpose::Actions {
            let steps_left = self.padded(&tensors::from_steps_left(queries.iter().map(|query| query.steps_left)));
            self.actions = tensors::to_floats(&self.agent.plan(&x, &x_g, &steps_left).actions);
            return vec![0.0; rows];
        }

        let inner_loop = self.agent.inner_loop();
        let actions = if source == Actions::Proposed {
            let proposed = inner_loop.policy_rollout(&x, &x_g);
            self.actions = tensors::to_floats(&proposed);
            proposed
        } else {
            let shape = [self.capacity as i64, inner_loop.horizon, -1];
            Tensor::from_slice(&self.actions).to_device(self.device).view(shape)
        };
        let losses = if purpose == Purpose::Gradient {
            let leaf = actions.detach().set_requires_grad(true);
            let losses = tch::with_grad(|| inner_loop.loss(&x, &x_g, &leaf));
            self.rollout = Some((leaf, losses.shallow_clone()));
            losses
        } else {
            inner_loop.loss(&x, &x_g, &actions)
        };
        tensors::to_floats(&losses.detach().narrow(0, 0, rows as i64))
    }

    fn descend(&mut self, _rows: usize) {
        let (leaf, losses) = self.rollout.take().expect("a rollout for its gradient came before");
        let total = tch::with_grad(|| losses.sum(None::<Kind>));
        let gradient = Tensor::run_backward(&[total], &[&leaf], false, false).remove(0);
        let moved = tch::no_grad(|| leaf.detach() - self.agent.inner_loop().step_size * gradient);
        self.actions = tensors::to_floats(&moved);
    }
}
