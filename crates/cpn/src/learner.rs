//! Training steps behind one interface, whatever computes them.

use crate::archive::Tensors;
use crate::batch::Batch;
use crate::model::Model;
use serde::Serialize;
use std::fmt::Debug;

/// A model in training.
pub trait Learner: Debug + Send {
    /// Moves the weights down the outer loss of a batch, by Adam.
    ///
    /// # Errors
    /// If the loss is not finite, or the device fails; the weights stay as they were.
    fn step(&mut self, batch: &Batch, learning_rate: f64) -> Result<Step, LearnerError>;

    /// The model with its current weights.
    fn model(&self) -> Model;

    /// Weights and the optimiser's moments by name: `weight.`, `mean.` and `square.` before each weight's name.
    fn state(&self) -> Tensors;

    /// Restores a [`Learner::state`] of `steps` steps.
    ///
    /// # Errors
    /// Names the tensor that is missing or of another shape.
    fn restore(&mut self, state: &Tensors, steps: u32) -> Result<(), LearnerError>;
}

/// Result of a training step.
#[derive(Debug, Clone, Copy)]
pub struct Step {
    /// The outer loss before the step.
    pub loss: f64,
    /// Norm of its gradient over all weights, before clipping.
    pub gradient_norm: f64,
    /// Time of the step's parts.
    pub times: StageTimes,
}

/// Parts of a training step, in seconds.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct StageTimes {
    /// The encoder; forward and backward in the native engine, forward in libtorch's.
    pub encoder_seconds: f64,
    /// Plans, the outer loss, and back to the embeddings; in libtorch's engine through the encoder, too.
    pub outer_loop_seconds: f64,
    /// The update of the weights.
    pub optimiser_seconds: f64,
}

/// A training step that failed, or a state that does not fit.
#[derive(Debug, thiserror::Error)]
pub enum LearnerError {
    /// A loss that is NaN or infinite.
    #[error("loss: expected a finite number, got {0}")]
    Loss(f64),
    /// A saved tensor that is missing, or of another shape or type.
    #[error("tensor \"{name}\": expected F32{shape:?}, got none such")]
    State {
        /// Name in the saved state.
        name: String,
        /// Shape of the weight.
        shape: Vec<usize>,
    },
    /// An error of the device that computes.
    #[error("{0}")]
    Device(String),
}
