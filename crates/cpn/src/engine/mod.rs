//! The outer loss and its gradient without an autograd graph: the passes over g_θ are derived by hand.
//!
//! A training step differentiates through the inner loop, and so through a gradient. In terms of one layer y = f(x):
//!
//! | pass | computes | what it is for |
//! |---|---|---|
//! | forward | y | the rollout |
//! | backward | x̄ = (∂y/∂x)ᵀ ȳ | the inner loop's gradient in the actions |
//! | tangent | ẏ = (∂y/∂x) ẋ | how that gradient acts along the direction the outer loss gives |
//! | adjoint | x̂ = ∂Φ/∂x and ∂Φ/∂θ, Φ = ŷᵀy + ȳᵀẏ | the outer gradient, both orders in one pass |
//!
//! The last row is what makes this cheap: the adjoint of ẏ is ȳ, which the inner loop has computed already, so that the
//! second order costs two passes more than the first and nothing is recorded but what the passes leave on a [tape](layers::dense).
//! The same quantities serve both branches of g_θ, and the policy's rollout is also the first rollout of the inner loop.
//!
//! A block of samples goes through all of that before the next one does, so that its tapes stay in the processor's caches. The
//! encoder f_φ is of the first order only: it goes forward over all frames, and back when their gradients are known
//! ([`Embedder`]). Tested against autograd in float64 (`tests/gradients.rs`).

mod embedder;
pub(crate) mod gemm;
pub(crate) mod layers;
pub(crate) mod networks;
mod outer;
pub(crate) mod planning;
pub(crate) mod simd;

pub use embedder::Embedder;
pub use layers::linear::Weights;
pub use outer::Samples;
pub use planning::planner::Planner;
pub use simd::element::Element;
pub use simd::vector::add;

use crate::config::ModelConfig;
use networks::policy_dynamics::PolicyDynamics;
use outer::{Settings, Sums, Workspace};
use rayon::prelude::*;

/// R, the samples of a block in training: more, and weights are read less often; fewer, and what the passes leave stays nearer.
const BLOCK: usize = 32;

/// Computes outer losses and their gradients, on some threads, in memory that is kept from batch to batch.
#[derive(Debug)]
pub struct OuterLoop<T> {
    config: ModelConfig,
    workers: Vec<Worker<T>>,
}

/// One thread's part.
#[derive(Debug, Default)]
struct Worker<T> {
    workspace: Option<Workspace<T>>,
    sums: Option<Sums<T>>,
}

/// The outer loss of a batch and its gradients.
#[derive(Debug)]
pub struct OuterGradient<T> {
    /// The loss.
    pub loss: T,
    /// In x, `[B, Z]`.
    pub x: Vec<T>,
    /// In x_g, `[B, Z]`.
    pub x_g: Vec<T>,
    /// In each weight that takes part, by its name in a checkpoint.
    pub weights: Vec<(String, Vec<T>)>,
}

impl<T: Element> OuterLoop<T> {
    /// For models of a valid configuration, on `threads` threads, at least one.
    pub fn new(config: ModelConfig, threads: usize) -> Self {
        let worker = || Worker { workspace: None, sums: None };
        Self { config, workers: (0..threads.max(1)).map(|_| worker()).collect() }
    }

    /// The outer loss of a batch. The order of its sums depends on nothing but the batch and the number of threads.
    pub fn run(&mut self, weights: &impl Weights<T>, samples: Samples<'_, T>) -> OuterGradient<T> {
        let network = PolicyDynamics::new(&self.config, weights);
        let (horizon, updates) = (self.config.horizon as usize, self.config.updates as usize);
        let known: T = samples.mask.iter().copied().sum();
        let settings = Settings {
            horizon,
            updates,
            step_size: weights.get("step_size")[0],
            scale: T::ONE / (known * T::count(network.sizes.actions)),
        };
        let latent = network.sizes.latent;
        let (mut x, mut x_g) = (vec![T::ZERO; samples.x.len()], vec![T::ZERO; samples.x.len()]);
        let share = samples.rows(latent).div_ceil(self.workers.len());
        let shares = x.par_chunks_mut(share * latent).zip(x_g.par_chunks_mut(share * latent));
        self.workers.par_iter_mut().zip(shares).enumerate().for_each(|(i, (worker, (x, x_g)))| {
            let sums = worker.sums.insert(Sums::zeros(&network));
            let workspace = worker.workspace.get_or_insert_with(|| Workspace::new(&network, BLOCK, horizon, updates));
            let blocks = x.chunks_mut(BLOCK * latent).zip(x_g.chunks_mut(BLOCK * latent));
            for (block, (x, x_g)) in blocks.enumerate() {
                let first = i * share + block * BLOCK;
                let samples = samples.part(latent, first, x.len() / latent);
                workspace.run(&network, settings, samples, (x, x_g), sums);
            }
        });
        let mut parts = self.workers.iter_mut().filter_map(|worker| worker.sums.take());
        let mut sums = parts.next().unwrap_or_else(|| Sums::zeros(&network));
        parts.for_each(|part| sums.add(&part));
        OuterGradient { loss: sums.loss, x, x_g, weights: sums.in_weights(&network, updates > 0) }
    }
}
