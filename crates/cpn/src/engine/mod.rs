//! Interface of engines, and the native engine: plans, the outer loss and its gradient by hand-derived passes over g_θ, without an
//! autograd graph.
//!
//! A training step differentiates through the inner loop, and so through a gradient. In terms of one layer y = f(x):
//!
//! | pass | computes | purpose |
//! |---|---|---|
//! | forward | y | the rollout |
//! | backward | x̄ = (∂y/∂x)ᵀ ȳ | the inner loop's gradient in the actions |
//! | tangent | ẏ = (∂y/∂x) ẋ | directional derivative of that gradient, along the direction given by the outer loss |
//! | adjoint | x̂ = ∂Φ/∂x and ∂Φ/∂θ, Φ = ŷᵀy + ȳᵀẏ | the outer gradient, both orders in one pass |
//!
//! The cotangent of ẏ is ȳ, which the inner loop has computed already. The second order thus costs two passes more than the
//! first, and needs no record besides the [tapes](layers::dense) of the passes. In the code, as in JAX and PyTorch, backward is
//! `vjp`, tangent `jvp` and adjoint `double_backward`; an adjoint of the first order alone, as in the encoder, is a `vjp` with the
//! weights among its inputs.
//! The same quantities serve both branches of g_θ, and the policy's rollout is also the first rollout of the inner loop.
//!
//! Six modules, each of which uses only those before it: `simd` (registers), `gemm` (matrix products), `layers`, `networks`,
//! `planning` (the inner loop) and `training` (the outer loop).
//!
//! All passes of a block of samples are computed before the next block, so that its tapes stay in the processor's caches. The
//! encoder f_φ is of the first order only: forward over all frames, and backward after their gradients are known
//! ([`EncoderPass`]). Tested against autograd in float64 (`crates/cpn-torch/tests/it/gradients.rs`).

pub(crate) mod gemm;
pub(crate) mod layers;
pub(crate) mod networks;
pub(crate) mod planning;
pub(crate) mod simd;
pub(crate) mod training;

use crate::learner::Learner;
use crate::method::Method;
use crate::model::Model;
use crate::precision::Precision;
use crate::recipe::Training;
use std::fmt::Debug;

pub use layers::linear::Weights;
pub use planning::planner::Planner;
pub use simd::element::Element;
pub use training::adam::Adam;
pub use training::encoder_pass::EncoderPass;
pub use training::learner::NativeLearner;
pub use training::outer_loop::OuterLoop;
pub use training::outer_loss::{Gradient, OuterLoss};
pub use training::samples::Samples;

/// An engine: computation of a model's plans and training steps on a device.
pub trait Engine: Debug + Send + Sync {
    /// A planner of a valid model, with images embedded in `precision` if the engine supports it.
    ///
    /// # Errors
    /// If the device fails; the error names the option to change.
    fn planner(&self, model: &Model, precision: Precision) -> Result<Box<dyn Method>, EngineError>;

    /// A learner of a valid model, with valid settings.
    ///
    /// # Errors
    /// If the device fails; the error names the option to change.
    fn learner(&self, model: Model, training: &Training) -> Result<Box<dyn Learner>, EngineError>;
}

/// Error of a device.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct EngineError(pub String);

/// The engine of this crate, on the processor.
#[derive(Debug, Clone, Copy)]
pub struct Native {
    /// Number of threads, at least one.
    pub threads: usize,
}

impl Engine for Native {
    fn planner(&self, model: &Model, precision: Precision) -> Result<Box<dyn Method>, EngineError> {
        Ok(Box::new(Planner::new(model, precision, self.threads)))
    }

    fn learner(&self, model: Model, training: &Training) -> Result<Box<dyn Learner>, EngineError> {
        Ok(Box::new(NativeLearner::new(model, training, self.threads)))
    }
}
