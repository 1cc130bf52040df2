//! Training steps of the native engine.

use super::adam::Adam;
use super::outer_loss::OuterLoss;
use crate::archive::Tensors;
use crate::batch::Batch;
use crate::config::ModelConfig;
use crate::learner::{Learner, LearnerError, StageTimes, Step};
use crate::model::Model;
use crate::recipe::Training;
use std::time::Instant;

/// A model in training on the processor.
#[derive(Debug)]
pub struct NativeLearner {
    config: ModelConfig,
    adam: Adam,
    outer_loss: OuterLoss,
    max_gradient_norm: f64,
}

impl NativeLearner {
    /// A learner of a valid model on `threads` threads, at least one, with valid settings.
    pub fn new(model: Model, training: &Training, threads: usize) -> Self {
        Self {
            adam: Adam::new(&model.weights),
            outer_loss: OuterLoss::new(&model.config, training.losses, training.precision.where_faster(), threads),
            max_gradient_norm: training.max_gradient_norm,
            config: model.config,
        }
    }
}

impl Learner for NativeLearner {
    fn step(&mut self, batch: &Batch, learning_rate: f64) -> Result<Step, LearnerError> {
        let started = Instant::now();
        let gradient = self.outer_loss.differentiate(&self.adam, batch);
        let loss = gradient.loss;
        if !loss.is_finite() {
            return Err(LearnerError::Loss(loss));
        }

        let differentiated = Instant::now();
        let gradient_norm = self.adam.step(&gradient.weights, learning_rate, self.max_gradient_norm);
        let times = StageTimes {
            encoder_seconds: gradient.encoder_seconds,
            outer_loop_seconds: (differentiated - started).as_secs_f64() - gradient.encoder_seconds,
            optimiser_seconds: differentiated.elapsed().as_secs_f64(),
        };
        Ok(Step { loss, gradient_norm, times })
    }

    fn model(&self) -> Model {
        Model { config: self.config.clone(), weights: self.adam.weights(), familiar: None }
    }

    fn state(&self) -> Tensors {
        self.adam.state()
    }

    fn restore(&mut self, state: &Tensors, steps: u32) -> Result<(), LearnerError> {
        self.adam.restore(state, steps)
    }
}
