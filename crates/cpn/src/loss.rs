//! The outer loop: behaviour cloning of the planned actions, through the inner loop.

use crate::agent::Agent;
use crate::encoder::Precision;
use crate::engine::networks::variables::{Variables, floats};
use crate::engine::{self, Embedder, OuterLoop, Samples};
use crate::observation::Frames;
use std::collections::BTreeMap;
use std::time::Instant;
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

/// An outer loss and what it changes by when the weights do.
#[derive(Debug)]
pub struct Gradient {
    /// The loss.
    pub loss: f64,
    /// By the name of the weight, row by row.
    pub weights: BTreeMap<String, Vec<f32>>,
    /// How long the encoder took, both ways, in seconds.
    pub encoder_seconds: f64,
}

/// Differentiates outer losses without a graph ([`crate::engine`]).
#[derive(Debug)]
pub struct OuterLoss {
    embedder: Embedder<f32>,
    outer_loop: OuterLoop<f32>,
}

impl OuterLoss {
    /// For agents like this one, with images embedded in this precision, on some threads.
    pub fn new(agent: &Agent, precision: Precision, threads: usize) -> Self {
        Self {
            embedder: Embedder::new(agent.config().encoder.clone(), precision, threads),
            outer_loop: OuterLoop::new(agent.config().clone(), threads),
        }
    }

    /// The outer loss of a batch and its gradient, by the name of each weight that takes part; agrees with what autograd
    /// makes of [`Agent::outer_loss`].
    pub fn differentiate(&mut self, agent: &Agent, batch: &Batch) -> Gradient {
        let started = Instant::now();
        let variables = agent.variables().variables();
        let (embeddings, embedded) = self.embedder.forward(&Variables(&variables), batch.frames.observed());
        let encoding = started.elapsed();
        let latent = agent.config().encoder.latent() as usize;
        let rows = |indices: &Tensor| floats::<i64>(indices).into_iter().map(|row| row as usize * latent);
        let gather = |indices| rows(indices).flat_map(|at| &embeddings[at..at + latent]).copied().collect::<Vec<f32>>();
        let (x, x_g) = (gather(&batch.observations), gather(&batch.goals));
        let (actions, mask) = (floats(&batch.actions), floats(&batch.mask));
        let samples = Samples { x: &x, x_g: &x_g, actions: &actions, mask: &mask };
        let outer = self.outer_loop.run(&Variables(&variables), samples);

        let mut hat = vec![0.0; embeddings.len()];
        for (indices, gradient) in [(&batch.observations, outer.x), (&batch.goals, outer.x_g)] {
            for (at, gradient) in rows(indices).zip(gradient.chunks_exact(latent)) {
                engine::add(&mut hat[at..at + latent], gradient);
            }
        }
        let started = Instant::now();
        let in_encoder = embedded.adjoint(&hat);
        Gradient {
            loss: outer.loss.into(),
            weights: outer.weights.into_iter().chain(in_encoder).collect(),
            encoder_seconds: (encoding + started.elapsed()).as_secs_f64(),
        }
    }
}
