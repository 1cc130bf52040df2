//! Outer loss: behaviour cloning of the planned actions.

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
    /// 1 for an action within the demonstration, else 0, `[B, H]`.
    pub mask: Tensor,
}

impl TensorBatch {
    /// A batch for plans of H = `horizon` steps, on a device.
    pub fn new(batch: &Batch, horizon: i64, device: Device) -> Self {
        let samples = batch.observations.len() as i64;
        let on_device = |tensor: Tensor| tensor.to_device(device);
        Self {
            frames: on_device(tensors::from_frames(&batch.frames)),
            observations: on_device(tensors::from_indices(&batch.observations)),
            goals: on_device(tensors::from_indices(&batch.goals)),
            steps_left: on_device(tensors::from_steps_left(batch.steps_left.iter().copied())),
            actions: on_device(Tensor::from_slice(&batch.actions).view([samples, horizon, -1])),
            mask: on_device(Tensor::from_slice(&batch.mask).view([samples, horizon])),
        }
    }
}

/// Mean squared error between planned and demonstrated actions, both `[B, H, A]`, over the steps within the demonstration, where
/// `mask`, `[B, H]`, is 1; it is 0 past the end.
pub fn behaviour_cloning(planned: &Tensor, demonstrated: &Tensor, mask: &Tensor) -> Tensor {
    let actions = planned.size()[2] as f64;
    let squared = (planned - demonstrated).square().sum_dim_intlist(2, false, None::<Kind>);
    (squared * mask).sum(None::<Kind>) / (mask.sum(None::<Kind>) * actions)
}
