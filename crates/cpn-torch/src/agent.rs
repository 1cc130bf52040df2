//! Agent: a learned method of the comparison, differentiable by autograd (section "Methods for comparison").

use crate::dynamics::PolicyDynamics;
use crate::encoder::Encoder;
use crate::inner_loop::{InnerLoop, TensorPlan};
use crate::loss::{self, TensorBatch};
use crate::tensors;
use cpn::{Model, ModelConfig};
use tch::{Device, Tensor, nn};

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
        let Model { config, weights } = model;
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
    pub fn outer_loss(&self, batch: &TensorBatch) -> Tensor {
        self.embedded_loss(&self.encoder.encode(&batch.frames), batch)
    }

    /// The outer loss of a batch with embedded frames, `[F, Z]`.
    pub fn embedded_loss(&self, embeddings: &Tensor, batch: &TensorBatch) -> Tensor {
        let (x, x_g) = (embeddings.index_select(0, &batch.observations), embeddings.index_select(0, &batch.goals));
        let planned = self.plan_differentiably(&x, &x_g, &batch.steps_left);
        loss::behaviour_cloning(&planned, &batch.actions, &batch.mask)
    }

    /// Planned actions, `[B, H, A]`, from x to x_g, both `[B, Z]`, with their graph; `steps_left` is k, `[B]`.
    pub fn plan_differentiably(&self, x: &Tensor, x_g: &Tensor, steps_left: &Tensor) -> Tensor {
        if self.config.method.plans() {
            self.inner_loop().plan_differentiably(x, x_g).actions
        } else {
            self.react(x, x_g, steps_left)
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
