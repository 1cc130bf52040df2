//! The trainer's entry: an outer loss of a batch of frames, and its gradient in every weight.

use super::encoder_pass::EncoderPass;
use super::outer_loop::{OuterLoop, Samples};
use crate::agent::Agent;
use crate::engine::networks::variables::{Variables, floats};
use crate::engine::simd::vector::add;
use crate::loss::Batch;
use crate::precision::Precision;
use std::collections::BTreeMap;
use std::time::Instant;
use tch::Tensor;

/// An outer loss with its gradient.
#[derive(Debug)]
pub struct Gradient {
    /// The loss.
    pub loss: f64,
    /// The gradient by the name of the weight, row by row.
    pub weights: BTreeMap<String, Vec<f32>>,
    /// Time in the encoder, forward and backward, in seconds.
    pub encoder_seconds: f64,
}

/// Outer losses and their gradients without a graph ([`crate::engine`]).
#[derive(Debug)]
pub struct OuterLoss {
    encoder_pass: EncoderPass<f32>,
    outer_loop: OuterLoop<f32>,
}

impl OuterLoss {
    /// Outer losses of agents with this one's configuration, with images embedded in this precision, on some threads.
    pub fn new(agent: &Agent, precision: Precision, threads: usize) -> Self {
        Self {
            encoder_pass: EncoderPass::new(agent.config().encoder.clone(), precision, threads),
            outer_loop: OuterLoop::new(agent.config().clone(), threads),
        }
    }

    /// The outer loss of a batch and its gradient, by the name of each weight that takes part; agrees with autograd's of
    /// [`Agent::outer_loss`].
    pub fn differentiate(&mut self, agent: &Agent, batch: &Batch) -> Gradient {
        let started = Instant::now();
        let variables = agent.variables().variables();
        let (embeddings, embedded) = self.encoder_pass.forward(&Variables(&variables), batch.frames.observed());
        let encoding = started.elapsed();

        // The samples' rows of the embeddings.
        let latent = agent.config().encoder.latent() as usize;
        let rows = |indices: &Tensor| floats::<i64>(indices).into_iter().map(|row| row as usize * latent);
        let gather = |indices| rows(indices).flat_map(|at| &embeddings[at..at + latent]).copied().collect::<Vec<f32>>();
        let (x, x_g) = (gather(&batch.observations), gather(&batch.goals));
        let (actions, mask) = (floats(&batch.actions), floats(&batch.mask));
        let samples = Samples { x: &x, x_g: &x_g, actions: &actions, mask: &mask };
        let outer = self.outer_loop.run(&Variables(&variables), samples);

        // Each frame's gradient is the sum over the samples that it belongs to.
        let mut hat = vec![0.0; embeddings.len()];
        for (indices, gradient) in [(&batch.observations, outer.x), (&batch.goals, outer.x_g)] {
            for (at, gradient) in rows(indices).zip(gradient.chunks_exact(latent)) {
                add(&mut hat[at..at + latent], gradient);
            }
        }

        let started = Instant::now();
        let in_encoder = embedded.vjp(&hat);
        Gradient {
            loss: outer.loss.into(),
            weights: outer.weights.into_iter().chain(in_encoder).collect(),
            encoder_seconds: (encoding + started.elapsed()).as_secs_f64(),
        }
    }
}
