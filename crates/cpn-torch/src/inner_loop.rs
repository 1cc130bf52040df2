//! Inner loop: planning by backpropagation towards the goal's embedding (section "Universal planning networks"), by autograd. The
//! native engine computes the same without a graph ([`cpn::engine`]).

use crate::dynamics::PolicyDynamics;
use tch::{Kind, Reduction, Tensor};

/// δ of the Huber loss: quadratic up to it, linear beyond.
const HUBER_DELTA: f64 = 1.0;

/// Planned action sequences with their inner losses.
#[derive(Debug)]
pub struct TensorPlan {
    /// â_{t:t+H}, `[B, H, A]`; not clipped.
    pub actions: Tensor,
    /// Inner losses, `[B]` each, before each update and, except in training, after the last; empty for methods that do not plan.
    pub inner_losses: Vec<Tensor>,
}

/// An inner loop with its settings.
#[derive(Debug, Clone, Copy)]
pub struct InnerLoop<'a> {
    /// g_θ.
    pub network: &'a PolicyDynamics,
    /// α, the step size of an update, a scalar; learned, except with position dynamics.
    pub step_size: &'a Tensor,
    /// H, the planning horizon.
    pub horizon: i64,
    /// U, the number of updates.
    pub updates: i64,
    /// Number of elements of a state, from the first on, that the loss compares.
    pub compared: i64,
}

impl InnerLoop<'_> {
    /// Plans from x to x_g, both `[B, Z]`, from the policy's rollout, without a graph.
    ///
    /// The loss is summed over the batch, not averaged, so that a plan's updates do not depend on B.
    pub fn plan(&self, x: &Tensor, x_g: &Tensor) -> TensorPlan {
        let _grad = tch::no_grad_guard();
        let mut actions = self.policy_rollout(x, x_g);
        let mut inner_losses = Vec::new();
        for _ in 0..self.updates {
            let leaf = actions.detach().set_requires_grad(true);
            let (loss, gradient) = tch::with_grad(|| self.loss_and_gradient(x, x_g, &leaf, false));
            inner_losses.push(loss.detach());
            actions = leaf.detach() - self.step_size * gradient;
        }
        inner_losses.push(self.loss(x, x_g, &actions));
        TensorPlan { actions, inner_losses }
    }

    /// The plans of [`Self::plan`] before and after each of `updates` updates, `[B, H, A]` each, with the graph of all updates, for
    /// the outer loop.
    pub fn plans_differentiably(&self, x: &Tensor, x_g: &Tensor, updates: i64) -> Vec<Tensor> {
        let mut plans = vec![self.policy_rollout(x, x_g)];
        for k in 0..updates as usize {
            let (_, gradient) = self.loss_and_gradient(x, x_g, &plans[k], true);
            plans.push(&plans[k] - self.step_size * gradient);
        }
        plans
    }

    /// Predicted states, `[B, Z]`, after each of the `actions`, `[B, H, A]`.
    pub fn states(&self, x: &Tensor, x_g: &Tensor, actions: &Tensor) -> Vec<Tensor> {
        let mut x = x.shallow_clone();
        let step = |action: &Tensor| {
            let features = self.network.features(&x, x_g);
            x = self.network.next(&x, &features, action);
            x.shallow_clone()
        };
        actions.unbind(1).iter().map(step).collect()
    }

    /// The initial plan: the policy's actions, `[B, H, A]`, along the predicted states.
    pub fn policy_rollout(&self, x: &Tensor, x_g: &Tensor) -> Tensor {
        let mut x = x.shallow_clone();
        let mut actions = Vec::new();
        for step in 0..self.horizon {
            let features = self.network.features(&x, x_g);
            let action = self.network.policy(&features);
            if step + 1 < self.horizon {
                x = self.network.next(&x, &features, &action);
            }
            actions.push(action);
        }
        Tensor::stack(&actions, 1)
    }

    /// Inner losses, `[B]`: Huber loss between the predicted state after `actions`, `[B, H, A]`, and the goal, summed over the
    /// compared elements.
    pub fn loss(&self, x: &Tensor, x_g: &Tensor, actions: &Tensor) -> Tensor {
        let states = self.states(x, x_g, actions);
        let compared = |states: &Tensor| states.narrow(1, 0, self.compared);
        let error = compared(&states[states.len() - 1]).huber_loss(&compared(x_g), Reduction::None, HUBER_DELTA);
        error.sum_dim_intlist(1, false, None::<Kind>)
    }

    /// Inner losses, `[B]`, and their gradient in the actions, `[B, H, A]`, itself differentiable with `create_graph`.
    pub fn loss_and_gradient(
        &self,
        x: &Tensor,
        x_g: &Tensor,
        actions: &Tensor,
        create_graph: bool,
    ) -> (Tensor, Tensor) {
        let loss = self.loss(x, x_g, actions);
        let total = loss.sum(None::<Kind>);
        let gradient = Tensor::run_backward(&[total], &[actions], create_graph, create_graph).remove(0);
        (loss, gradient)
    }
}
