//! The inner loop: planning by backpropagation towards the goal's embedding (section "Universal planning networks"), by
//! autograd. What is served does the same without a graph ([`cpn::engine`]).

use crate::dynamics::PolicyDynamics;
use tch::{Kind, Reduction, Tensor};

/// Where the Huber loss turns from quadratic to linear.
const HUBER_DELTA: f64 = 1.0;

/// A planned action sequence and how close it is predicted to come.
#[derive(Debug)]
pub struct TensorPlan {
    /// â_{t:t+H}, `[B, H, A]`; not clipped.
    pub actions: Tensor,
    /// The inner loss of each plan `[B]`, before each update and, unless training, after the last; empty for methods
    /// that do not plan.
    pub inner_losses: Vec<Tensor>,
}

/// How an inner loop is run.
#[derive(Debug, Clone, Copy)]
pub struct InnerLoop<'a> {
    /// g_θ.
    pub network: &'a PolicyDynamics,
    /// α, the learned step size of an update, a scalar.
    pub step_size: &'a Tensor,
    /// H, the number of planned steps.
    pub horizon: i64,
    /// U, the number of updates.
    pub updates: i64,
}

impl InnerLoop<'_> {
    /// Plans from x to x_g, both `[B, Z]`, starting from the policy's rollout.
    ///
    /// Each plan of a batch is independent of the others: the loss is summed over the batch, so that the step an action
    /// takes does not depend on B.
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

    /// The same plan with the graph of every update kept, for the outer loop to differentiate through.
    pub fn plan_differentiably(&self, x: &Tensor, x_g: &Tensor) -> TensorPlan {
        let mut actions = self.policy_rollout(x, x_g);
        let mut inner_losses = Vec::new();
        for _ in 0..self.updates {
            let (loss, gradient) = self.loss_and_gradient(x, x_g, &actions, true);
            inner_losses.push(loss.detach());
            // Not `-=`, which would overwrite what the graph still needs.
            actions = &actions - self.step_size * gradient;
        }
        TensorPlan { actions, inner_losses }
    }

    /// The initial plan: the actions `[B, H, A]` of the policy along its own predicted states.
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

    /// The inner loss of each plan, `[B]`: Huber between the state predicted after `actions` `[B, H, A]` and the goal,
    /// summed over the latent.
    pub fn loss(&self, x: &Tensor, x_g: &Tensor, actions: &Tensor) -> Tensor {
        let mut x = x.shallow_clone();
        for action in actions.unbind(1) {
            let features = self.network.features(&x, x_g);
            x = self.network.next(&x, &features, &action);
        }
        x.huber_loss(x_g, Reduction::None, HUBER_DELTA).sum_dim_intlist(1, false, None::<Kind>)
    }

    /// The inner loss `[B]` and its gradient in the actions `[B, H, A]`.
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
