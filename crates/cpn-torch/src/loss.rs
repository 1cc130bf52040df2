//! Batches as tensors, and the error of the outer loss.

use crate::tensors;
use cpn::Batch;
use tch::{Device, Kind, Tensor};

/// A batch as tensors.
#[derive(Debug)]
pub struct TensorBatch {
    /// Distinct images `[F, 84, 84, 3]`, bytes, or positions `[F, 3]`, metres.
    pub frames: Tensor,
    /// Index of each sample's observation among the frames, `[B]` integers.
    pub observations: Tensor,
    /// Index of each sample's goal among the frames, `[B]` integers.
    pub goals: Tensor,
    /// k, the scaled number of steps left, `[B]`.
    pub steps_left: Tensor,
    /// Demonstrated actions after the observation, `[B, H, A]`; 0 past the demonstration's end.
    pub actions: Tensor,
    /// Actions that were applied, `[B, H, A]`; empty without a dynamics loss.
    pub applied_actions: Tensor,
    /// 1 for an action within the demonstration, else 0, `[B, H]`.
    pub mask: Tensor,
    /// Index among the frames of the frame after each action, `[B, H]` integers; empty without a dynamics loss.
    pub next: Tensor,
    /// Standardised position of the hand in each frame, `[F, 3]`; empty without a position loss.
    pub positions: Tensor,
}

impl TensorBatch {
    /// A batch for plans of H = `horizon` steps, on a device.
    pub fn new(batch: &Batch, horizon: i64, device: Device) -> Self {
        let samples = batch.observations.len() as i64;
        let action_size = batch.actions.len() as i64 / (samples * horizon);
        let on_device = |tensor: Tensor| tensor.to_device(device);
        Self {
            frames: on_device(tensors::from_frames(&batch.frames)),
            observations: on_device(tensors::from_indices(&batch.observations)),
            goals: on_device(tensors::from_indices(&batch.goals)),
            steps_left: on_device(tensors::from_steps_left(batch.steps_left.iter().copied())),
            actions: on_device(Tensor::from_slice(&batch.actions).view([samples, horizon, -1])),
            applied_actions: on_device(Tensor::from_slice(&batch.applied_actions).view([-1, horizon, action_size])),
            mask: on_device(Tensor::from_slice(&batch.mask).view([samples, horizon])),
            next: on_device(tensors::from_indices(&batch.next).view([-1, horizon])),
            positions: on_device(Tensor::from_slice(batch.positions.as_flattened()).view([-1, 3])),
        }
    }
}

/// Mean squared error between planned and demonstrated actions, or predicted and later states, `[B, H, N]`, over the steps within the
/// demonstration, where `mask`, `[B, H]`, is 1; it is 0 past the end.
pub fn mean_squared(predicted: &Tensor, demonstrated: &Tensor, mask: &Tensor) -> Tensor {
    let size = predicted.size()[2] as f64;
    let squared = (predicted - demonstrated).square().sum_dim_intlist(2, false, None::<Kind>);
    (squared * mask).sum(None::<Kind>) / (mask.sum(None::<Kind>) * size)
}
