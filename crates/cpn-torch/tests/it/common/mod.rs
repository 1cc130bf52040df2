//! Agents and batches for tests.

use cpn::{Model, ModelConfig};
use cpn_torch::loss::TensorBatch;
use cpn_torch::{Agent, tensors};
use tch::{Device, Kind, Tensor};

/// An agent in float64, so that errors of gradients exceed rounding.
pub fn double_agent(model: &Model) -> Agent {
    let mut agent = Agent::new(model, Device::Cpu);
    agent.variables_mut().double();
    agent
}

/// An agent in float64 with initial weights.
pub fn new_agent(config: ModelConfig) -> Agent {
    double_agent(&Model::new(config, 3))
}

/// Random images, `[B, 84, 84, 3]`.
pub fn noise_images(batch: usize, seed: u64) -> Tensor {
    tensors::from_images(&testing::noise_images(batch, seed))
}

/// Random values in [-1, 1), float64.
pub fn uniform(shape: &[i64], seed: u64) -> Tensor {
    Tensor::from_slice(&testing::uniform(shape.iter().product::<i64>() as usize, seed)).view(shape)
}

/// k, the scaled number of steps left, `[B]`, float64: different for each sample.
pub fn steps_left(batch: i64) -> Tensor {
    Tensor::arange(batch, (Kind::Double, Device::Cpu)) / batch
}

/// A batch with a separate goal for each observation.
pub fn paired(observations: &Tensor, goals: &Tensor, actions: &Tensor, mask: &Tensor) -> TensorBatch {
    let count = observations.size()[0];
    let rows = |first| Tensor::arange_start(first, first + count, (Kind::Int64, Device::Cpu));
    TensorBatch {
        frames: Tensor::cat(&[observations, goals], 0),
        observations: rows(0),
        goals: rows(count),
        steps_left: steps_left(count),
        actions: actions.shallow_clone(),
        applied_actions: actions.neg(),
        mask: mask.shallow_clone(),
        next: Tensor::zeros([0, actions.size()[1]], (Kind::Int64, Device::Cpu)),
        positions: Tensor::zeros([0, 3], (Kind::Float, Device::Cpu)),
    }
}
