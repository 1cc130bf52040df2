//! Training steps by libtorch: the outer loss differentiated by autograd, and Adam on one vector of all weights.

use crate::agent::Agent;
use crate::engine::on_device;
use crate::loss::TensorBatch;
use crate::tensors;
use cpn::archive::{self, Tensors};
use cpn::learner::{Learner, LearnerError, StageTimes, Step};
use cpn::{Batch, Losses, Model, Training};
use std::collections::BTreeMap;
use std::time::Instant;
use tch::{Device, Tensor};

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// A model in training on a device of libtorch.
#[derive(Debug)]
pub struct TorchLearner {
    agent: Agent,
    device: Device,
    threads: usize,
    losses: Losses,
    max_gradient_norm: f64,
    /// The agent's weights by name, views of `values`.
    weights: BTreeMap<String, Tensor>,
    /// All weights as one vector, in the order of their names.
    values: Tensor,
    /// First moment of the gradients, as one vector.
    mean: Tensor,
    /// Second moment of the gradients, as one vector.
    square: Tensor,
    /// Number of updates so far.
    steps: u32,
}

impl TorchLearner {
    /// A learner of a valid model with valid settings; `threads` applies to the processor.
    pub fn new(model: &Model, training: &Training, device: Device, threads: usize) -> Self {
        let agent = Agent::new(model, device);
        let mut weights: BTreeMap<String, Tensor> = agent.variables().variables().into_iter().collect();
        let flat: Vec<Tensor> = weights.values().map(|weight| weight.detach().flatten(0, -1)).collect();
        let values = Tensor::cat(&flat, 0);

        // The variables become views of the vector, so that one update changes all of them.
        let mut first = 0;
        for weight in weights.values_mut() {
            let part = values.narrow(0, first, weight.numel() as i64).view_as(weight);
            weight.set_data(&part);
            first += weight.numel() as i64;
        }

        let (mean, square) = (values.zeros_like(), values.zeros_like());
        let &Training { losses, max_gradient_norm, .. } = training;
        Self { agent, device, threads, losses, max_gradient_norm, weights, values, mean, square, steps: 0 }
    }

    /// The gradient of a loss in all weights, as one vector; 0 for weights that do not affect it.
    fn gradient(&mut self, loss: &Tensor) -> Tensor {
        loss.backward();
        let of = |weight: &mut Tensor| {
            let gradient = weight.grad();
            let gradient = if gradient.defined() { gradient } else { weight.zeros_like() };
            gradient.flatten(0, -1)
        };
        let gradients: Vec<Tensor> = self.weights.values_mut().map(of).collect();
        let gradient = Tensor::cat(&gradients, 0);
        self.weights.values_mut().for_each(Tensor::zero_grad);
        gradient
    }

    /// An update by a gradient, clipped to the maximum norm; returns the norm before clipping.
    fn update(&mut self, gradient: &Tensor, learning_rate: f64) -> f64 {
        let norm = gradient.norm().double_value(&[]);
        let clipped = gradient * (self.max_gradient_norm / (norm + 1e-6)).min(1.0);

        self.steps += 1;
        let [bias_1, bias_2] = [BETA_1, BETA_2].map(|beta| 1.0 - beta.powi(self.steps.cast_signed()));
        let _ = self.mean.g_mul_scalar_(BETA_1).g_add_(&(&clipped * (1.0 - BETA_1)));
        let _ = self.square.g_mul_scalar_(BETA_2).g_add_(&(clipped.square() * (1.0 - BETA_2)));
        let scale = (&self.square / bias_2).sqrt() + EPSILON;
        let _ = self.values.g_sub_(&(&self.mean * (learning_rate / bias_1) / scale));
        norm
    }

    fn step_on_device(&mut self, batch: &Batch, learning_rate: f64) -> Result<Step, LearnerError> {
        if !self.device.is_cuda() {
            // libtorch's number of threads is a setting of the calling thread.
            tch::set_num_threads(self.threads as i32);
        }
        let started = Instant::now();
        let batch = TensorBatch::new(batch, self.agent.config().horizon, self.device);
        let embeddings = self.agent.encoder().encode(&batch.frames);
        let encoded = Instant::now();
        let loss_tensor = self.agent.embedded_loss(&embeddings, &batch, self.losses);
        let loss = loss_tensor.double_value(&[]);
        if !loss.is_finite() {
            return Err(LearnerError::Loss(loss));
        }

        let gradient = self.gradient(&loss_tensor);
        let differentiated = Instant::now();
        let gradient_norm = tch::no_grad(|| self.update(&gradient, learning_rate));
        let times = StageTimes {
            encoder_seconds: (encoded - started).as_secs_f64(),
            outer_loop_seconds: (differentiated - encoded).as_secs_f64(),
            optimiser_seconds: differentiated.elapsed().as_secs_f64(),
        };
        Ok(Step { loss, gradient_norm, times })
    }

    /// A vector over all weights, divided by their names.
    fn by_name<'a>(&'a self, vector: &'a Tensor) -> impl Iterator<Item = (&'a String, archive::Tensor)> {
        let mut first = 0;
        self.weights.iter().map(move |(name, weight)| {
            let part = vector.narrow(0, first, weight.numel() as i64).view_as(weight);
            first += weight.numel() as i64;
            (name, tensors::to_archive(&part))
        })
    }
}

impl Learner for TorchLearner {
    fn step(&mut self, batch: &Batch, learning_rate: f64) -> Result<Step, LearnerError> {
        on_device(self.device, || self.step_on_device(batch, learning_rate)).map_err(LearnerError::Device)?
    }

    fn model(&self) -> Model {
        let weights = self.by_name(&self.values).map(|(name, weight)| (name.clone(), weight)).collect();
        Model { config: self.agent.config().clone(), weights, familiar: None }
    }

    fn state(&self) -> Tensors {
        let parts = [("weight", &self.values), ("mean", &self.mean), ("square", &self.square)];
        let named = |(part, vector)| self.by_name(vector).map(move |(name, tensor)| (format!("{part}.{name}"), tensor));
        parts.into_iter().flat_map(named).collect()
    }

    fn restore(&mut self, state: &Tensors, steps: u32) -> Result<(), LearnerError> {
        for (part, vector) in [("weight", &self.values), ("mean", &self.mean), ("square", &self.square)] {
            let mut first = 0;
            for (name, weight) in &self.weights {
                let name = format!("{part}.{name}");
                let shape: Vec<usize> = weight.size().iter().map(|size| *size as usize).collect();
                let saved =
                    state.get(&name).filter(|saved| saved.shape() == shape && saved.elements::<f32>().is_some());
                let saved = saved.ok_or(LearnerError::State { name, shape })?;
                let mut target = vector.narrow(0, first, weight.numel() as i64).view_as(weight);
                tch::no_grad(|| target.copy_(&tensors::from_archive(saved)));
                first += weight.numel() as i64;
            }
        }
        self.steps = steps;
        Ok(())
    }
}
