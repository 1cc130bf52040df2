//! Interface of training steps, common to all engines.

use crate::archive::Tensors;
use crate::batch::Batch;
use crate::model::Model;
use serde::Serialize;
use std::fmt::Debug;

/// A model in training.
pub trait Learner: Debug + Send {
    /// One step of Adam on the outer loss of a batch.
    ///
    /// # Errors
    /// If the loss is not finite, or the device fails; the weights are then unchanged.
    fn step(&mut self, batch: &Batch, learning_rate: f64) -> Result<Step, LearnerError>;

    /// The model with its current weights.
    fn model(&self) -> Model;

    /// Weights and the optimiser's first and second moments, named by the prefixes `weight.`, `mean.` and `square.` and the
    /// weight's name.
    fn state(&self) -> Tensors;

    /// Restores a [`Learner::state`] after `steps` steps.
    ///
    /// # Errors
    /// The first tensor that is missing, or of another shape or type.
    fn restore(&mut self, state: &Tensors, steps: u32) -> Result<(), LearnerError>;
}

/// Result of a training step.
#[derive(Debug, Clone, Copy)]
pub struct Step {
    /// Outer loss before the step.
    pub loss: f64,
    /// Norm of the gradient over all weights, before clipping.
    pub gradient_norm: f64,
    /// Time of the step's stages.
    pub times: StageTimes,
}

/// Time of a training step's stages, in seconds.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct StageTimes {
    /// Encoder: forward and backward in the native engine, forward only in libtorch's.
    pub encoder_seconds: f64,
    /// Inner loop, outer loss and their backward pass to the embeddings; in libtorch's engine also the encoder's backward pass.
    pub outer_loop_seconds: f64,
    /// Update of the weights.
    pub optimiser_seconds: f64,
}

/// Error of a training step, or of a state to restore.
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
    /// Error of the device.
    #[error("{0}")]
    Device(String),
}
