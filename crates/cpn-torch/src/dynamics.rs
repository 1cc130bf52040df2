//! Policy dynamics network g_θ (figure "encoder", b).

use crate::neuromodulated::Neuromodulated;
use cpn::ModelConfig;
use tch::Tensor;
use tch::nn::{self, Module};

/// The network g_θ: a shared trunk, a policy branch, and a dynamics branch with the action as an additional input.
#[derive(Debug)]
pub struct PolicyDynamics {
    trunk: Dense,
    policy: [Dense; 2],
    dynamics: Option<[Dense; 2]>,
    /// Motion of the position, the first P elements of a state, by an action, `[P, A]`.
    position: Option<Tensor>,
    goal_conditioned: bool,
}

impl PolicyDynamics {
    /// Builds the variables under `path`, by the method: with a dynamics branch if it plans, neuromodulated layers and goal
    /// conditioning if it has them.
    pub fn new(path: &nn::Path, config: &ModelConfig) -> Self {
        let ModelConfig { method, hidden, actions, .. } = *config;
        let latent = config.encoder.latent();
        let dense = |name: &str, inputs, outputs| Dense::new(&(path / name), inputs, outputs, config);
        Self {
            trunk: dense("trunk", config.trunk_inputs(), hidden),
            policy: [dense("policy_0", hidden, hidden), dense("policy_1", hidden, actions)],
            dynamics: method
                .plans()
                .then(|| [dense("dynamics_0", hidden + actions, hidden), dense("dynamics_1", hidden, latent)]),
            position: config
                .position_dynamics
                .then(|| (path / "position").zeros("weight", &[config.compared_elements(), actions])),
            goal_conditioned: method.is_goal_conditioned(),
        }
    }

    /// The trunk: features `[B, hidden]` of a state x and a goal x_g, both `[B, Z]`; for a method that takes the number of steps left,
    /// x_g has one more column.
    pub fn features(&self, x: &Tensor, x_g: &Tensor) -> Tensor {
        let input = if self.goal_conditioned { Tensor::cat(&[x, x_g], 1) } else { x.shallow_clone() };
        self.trunk.forward(&input).relu()
    }

    /// The policy branch: an action `[B, A]` in (-1, 1) of features `[B, hidden]`.
    pub fn policy(&self, features: &Tensor) -> Tensor {
        self.policy[1].forward(&self.policy[0].forward(features).relu()).tanh()
    }

    /// The dynamics branch: the state `[B, Z]` after an action `[B, A]`, predicted as a difference to x, whose first elements are linear
    /// in the action with position dynamics.
    ///
    /// # Panics
    /// If the method does not plan.
    pub fn next(&self, x: &Tensor, features: &Tensor, action: &Tensor) -> Tensor {
        let [first, second] = self.dynamics.as_ref().expect("only planning methods roll out");
        let change = second.forward(&first.forward(&Tensor::cat(&[features, action], 1)).relu());
        let Some(position) = &self.position else { return x + change };
        let size = position.size()[0];
        let rest = change.narrow(1, size, change.size()[1] - size);
        x + Tensor::cat(&[action.matmul(&position.tr()), rest], 1)
    }
}

/// A fully connected layer, plain or neuromodulated.
#[derive(Debug)]
enum Dense {
    Linear(nn::Linear),
    Neuromodulated(Neuromodulated),
}

impl Dense {
    fn new(path: &nn::Path, inputs: i64, outputs: i64, config: &ModelConfig) -> Self {
        if config.method.is_neuromodulated() {
            Self::Neuromodulated(Neuromodulated::new(path, inputs, outputs, config.gate_hidden))
        } else {
            Self::Linear(nn::linear(path, inputs, outputs, Default::default()))
        }
    }
}

impl Module for Dense {
    fn forward(&self, x: &Tensor) -> Tensor {
        match self {
            Self::Linear(layer) => layer.forward(x),
            Self::Neuromodulated(layer) => layer.forward(x),
        }
    }
}
