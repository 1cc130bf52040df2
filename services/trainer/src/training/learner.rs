//! One step of the outer loop: loss, gradient, update.

use crate::training::adam::Adam;
use anyhow::ensure;
use cpn::engine::OuterLoss;
use cpn::loss::Batch;
use cpn::{Agent, Recipe};
use serde::Serialize;
use std::time::Instant;

/// A model in training.
#[derive(Debug)]
pub struct Learner {
    /// The model.
    pub agent: Agent,
    /// What moves its weights.
    pub optimiser: Adam,
    outer_loss: OuterLoss,
    max_gradient_norm: f64,
}

/// What a step came to.
#[derive(Debug, Clone, Copy)]
pub struct Learnt {
    /// The outer loss before the step.
    pub loss: f64,
    /// Norm of its gradient over all weights, before it was clipped.
    pub gradient_norm: f64,
    /// Where the time went.
    pub times: StageTimes,
}

/// The parts of a step, in seconds.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct StageTimes {
    /// The encoder, both ways.
    pub encoder_seconds: f64,
    /// Everything past it: plans, the outer loss, and back to the embeddings.
    pub outer_loop_seconds: f64,
    /// The update of the weights.
    pub optimiser_seconds: f64,
}

impl Learner {
    /// A freshly initialised model of a valid recipe.
    pub fn new(recipe: &Recipe, seed: u64, threads: usize) -> Self {
        let agent = Agent::new(recipe.model.clone(), seed);
        Self {
            optimiser: Adam::new(agent.variables()),
            outer_loss: OuterLoss::new(&agent, recipe.training.precision.where_faster(), threads),
            agent,
            max_gradient_norm: recipe.training.max_gradient_norm,
        }
    }

    /// Moves the weights down the outer loss of a batch.
    ///
    /// # Errors
    /// If the loss is not finite; the weights stay as they are then.
    pub fn step(&mut self, batch: &Batch, learning_rate: f64) -> anyhow::Result<Learnt> {
        let started = Instant::now();
        let gradient = self.outer_loss.differentiate(&self.agent, batch);
        let loss = gradient.loss;
        ensure!(loss.is_finite(), "loss: expected a finite number, got {loss}");
        let differentiated = Instant::now();
        let gradient_norm = self.optimiser.step(&gradient, learning_rate, self.max_gradient_norm);
        let times = StageTimes {
            encoder_seconds: gradient.encoder_seconds,
            outer_loop_seconds: (differentiated - started).as_secs_f64() - gradient.encoder_seconds,
            optimiser_seconds: differentiated.elapsed().as_secs_f64(),
        };
        Ok(Learnt { loss, gradient_norm, times })
    }
}
