//! The outer loop: behaviour cloning of the planned actions.

use tch::{Kind, Tensor};

/// Mean squared error between planned and demonstrated actions, both `[B, H, A]`, over the steps that the demonstration
/// still has: `mask` `[B, H]` is 1 there and 0 past its end.
pub fn behaviour_cloning(planned: &Tensor, demonstrated: &Tensor, mask: &Tensor) -> Tensor {
    let actions = planned.size()[2] as f64;
    let squared = (planned - demonstrated).square().sum_dim_intlist(2, false, None::<Kind>);
    (squared * mask).sum(None::<Kind>) / (mask.sum(None::<Kind>) * actions)
}
