//! The outer loop: behaviour cloning of the planned actions, through the inner loop.

use crate::observation::Frames;
use tch::{Kind, Tensor};

/// The tensors of a training step.
#[derive(Debug)]
pub struct Batch {
    /// Every image or position of the batch once.
    pub frames: Frames,
    /// Which frame each sample observes, `[B]` integers.
    pub observations: Tensor,
    /// Which frame is its goal, `[B]` integers.
    pub goals: Tensor,
    /// The demonstrated actions that follow, `[B, H, A]`; 0 past the demonstration's end.
    pub actions: Tensor,
    /// 1 where there is an action, else 0, `[B, H]`.
    pub mask: Tensor,
}

/// Mean squared error between planned and demonstrated actions, both `[B, H, A]`, over the steps that the demonstration
/// still has: `mask` `[B, H]` is 1 there and 0 past its end.
pub fn behaviour_cloning(planned: &Tensor, demonstrated: &Tensor, mask: &Tensor) -> Tensor {
    let actions = planned.size()[2] as f64;
    let squared = (planned - demonstrated).square().sum_dim_intlist(2, false, None::<Kind>);
    (squared * mask).sum(None::<Kind>) / (mask.sum(None::<Kind>) * actions)
}
