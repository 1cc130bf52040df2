//! Agent: a learned method of the comparison, differentiable by autograd (section "Methods for comparison").

use crate::dynamics::PolicyDynamics;
use crate::encoder::Encoder;
use crate::inner_loop::{InnerLoop, TensorPlan};
use crate::loss::{self, TensorBatch};
use crate::tensors;
use cpn::{Losses, Model, ModelConfig};
use tch::{Device, Reduction, Tensor, nn};

/// A learned method: encoder, g_θ and the step size of its inner loop.
#[derive(Debug)]
pub struct Agent {
    config: ModelConfig,
    variables: nn::VarStore,
    encoder: Encoder,
    network: PolicyDynamics,
    step_size: Tensor,
}

impl Agent {
    /// The agent of a valid model on a device.
    pub fn new(model: &Model, device: Device) -> Self {
        let Model { config, weights, .. } = model;
        let variables = nn::VarStore::new(device);
        let root = variables.root();
        let agent = Self {
            encoder: Encoder::new(&(&root / "encoder"), &config.encoder),
            network: PolicyDynamics::new(&(&root / "network"), config),
            step_size: root.ones("step_size", &[]),
            config: config.clone(),
            variables,
        };
        for (name, mut variable) in agent.variables.variables() {
            tch::no_grad(|| variable.copy_(&tensors::from_archive(&weights[&name])));
        }
        agent
    }

    /// Configuration of the model.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// Weights by name.
    pub fn variables(&self) -> &nn::VarStore {
        &self.variables
    }

    /// Mutable weights by name, for freezing them or changing their kind.
    pub fn variables_mut(&mut self) -> &mut nn::VarStore {
        &mut self.variables
    }

    /// The outer loss of a batch, a scalar, differentiable in the weights through the inner loop's updates by autograd: the
    /// reference for [`OuterLoss`](cpn::engine::OuterLoss).
    pub fn outer_loss(&self, batch: &TensorBatch, losses: Losses) -> Tensor {
        self.embedded_loss(&self.encoder.encode(&batch.frames), batch, losses)
    }

    /// The outer loss of a batch with embedded frames, `[F, Z]`.
    pub fn embedded_loss(&self, embeddings: &Tensor, batch: &TensorBatch, losses: Losses) -> Tensor {
        let rows = |indices: &Tensor| embeddings.index_select(0, &indices.flatten(0, -1));
        let (x, x_g) = (rows(&batch.observations), rows(&batch.goals));
        let next = if losses.dynamics > 0.0 { Some(rows(&batch.next).detach()) } else { None };
        let loss = self.loss_from(&x, &x_g, next.as_ref(), batch, losses);
        if losses.position == 0.0 {
            return loss;
        }
        let first = embeddings.narrow(1, 0, 3);
        loss + first.mse_loss(&batch.positions.to_kind(first.kind()), Reduction::Mean) * losses.position
    }

    /// The outer loss from x to x_g, both `[B, Z]`; `next`, `[B H, Z]`, are the embeddings after the applied actions.
    pub fn loss_from(
        &self,
        x: &Tensor,
        x_g: &Tensor,
        next: Option<&Tensor>,
        batch: &TensorBatch,
        losses: Losses,
    ) -> Tensor {
        let plans = self.plans_differentiably(x, x_g, &batch.steps_left);
        let cloned = if losses.every_update { &plans[..] } else { &plans[plans.len() - 1..] };
        let cloning = cloned.iter().map(|plan| loss::mean_squared(plan, &batch.actions, &batch.mask));
        let cloning = cloning.sum::<Tensor>() / cloned.len() as f64;
        let Some(next) = next else { return cloning };
        let states = Tensor::stack(&self.inner_loop().states(x, x_g, &batch.applied_actions), 1);
        let compared = |states: &Tensor| states.narrow(2, 0, self.config.compared_elements());
        let (predicted, later) = (compared(&states), compared(&next.view_as(&states)));
        cloning + loss::mean_squared(&predicted, &later, &batch.mask) * losses.dynamics
    }

    /// Planned actions before and after every update, `[B, H, A]` each, from x to x_g, both `[B, Z]`, with their graph;
    /// `steps_left` is k, `[B]`.
    fn plans_differentiably(&self, x: &Tensor, x_g: &Tensor, steps_left: &Tensor) -> Vec<Tensor> {
        if self.config.method.plans() {
            self.inner_loop().plans_differentiably(x, x_g, self.config.trained_updates())
        } else {
            vec![self.react(x, x_g, steps_left)]
        }
    }

    /// The encoder.
    pub fn encoder(&self) -> &Encoder {
        &self.encoder
    }

    /// The inner loop of a planning method.
    pub fn inner_loop(&self) -> InnerLoop<'_> {
        InnerLoop {
            network: &self.network,
            step_size: &self.step_size,
            horizon: self.config.horizon,
            updates: self.config.updates,
            compared: self.config.compared_elements(),
        }
    }

    /// The policy's action for x and x_g `[B, Z]`, and k `[B]` if the method takes it, as a plan of one step `[B, 1, A]`.
    fn react(&self, x: &Tensor, x_g: &Tensor, steps_left: &Tensor) -> Tensor {
        let features = if self.config.method.takes_steps_left() {
            self.network.features(x, &Tensor::cat(&[x_g, &steps_left.unsqueeze(1)], 1))
        } else {
            self.network.features(x, x_g)
        };
        self.network.policy(&features).unsqueeze(1)
    }

    /// H, the planning horizon.
    pub fn horizon(&self) -> i64 {
        self.config.horizon
    }

    /// Embeddings, `[B, Z]`, of images, `[B, 84, 84, 3]`, or positions, `[B, 3]`, without a graph.
    pub fn encode(&self, input: &Tensor) -> Tensor {
        tch::no_grad(|| self.encoder.encode(input))
    }

    /// Plans from x to x_g, both `[B, Z]`, without a graph: the reference for [`Planner`](cpn::Planner). `steps_left` is k, `[B]`.
    pub fn plan(&self, x: &Tensor, x_g: &Tensor, steps_left: &Tensor) -> TensorPlan {
        if self.config.method.plans() {
            self.inner_loop().plan(x, x_g)
        } else {
            TensorPlan { actions: tch::no_grad(|| self.react(x, x_g, steps_left)), inner_losses: Vec::new() }
        }
    }
}
