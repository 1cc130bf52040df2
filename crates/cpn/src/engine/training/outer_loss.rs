//! Outer loss of a batch of frames, with its gradient in all weights: encoder and outer loop combined.

use super::encoder_pass::EncoderPass;
use super::outer_loop::OuterLoop;
use super::samples::Samples;
use crate::batch::Batch;
use crate::config::ModelConfig;
use crate::engine::layers::linear::Weights;
use crate::engine::simd::vector::add;
use crate::precision::Precision;
use crate::recipe::Losses;
use crate::steps_left;
use std::collections::BTreeMap;
use std::time::Instant;

/// An outer loss with its gradient.
#[derive(Debug)]
pub struct Gradient {
    /// The loss.
    pub loss: f64,
    /// The gradient by the weights' names in a checkpoint, in row-major order.
    pub weights: BTreeMap<String, Vec<f32>>,
    /// Time in the encoder, forward and backward, in seconds.
    pub encoder_seconds: f64,
}

/// Outer losses and their gradients, without an autograd graph ([`crate::engine`]).
#[derive(Debug)]
pub struct OuterLoss {
    /// Z, the size of an embedding.
    latent: usize,
    losses: Losses,
    encoder_pass: EncoderPass<f32>,
    outer_loop: OuterLoop<f32>,
}

impl OuterLoss {
    /// Outer losses of models with a valid configuration, with images embedded in `precision`, on `threads` threads, at least one.
    pub fn new(config: &ModelConfig, losses: Losses, precision: Precision, threads: usize) -> Self {
        Self {
            latent: config.encoder.latent() as usize,
            losses,
            encoder_pass: EncoderPass::new(config.encoder.clone(), precision, threads),
            outer_loop: OuterLoop::new(config.clone(), losses, threads),
        }
    }

    /// The outer loss of a batch and its gradient, for weights that affect the loss. It equals autograd's, within rounding errors.
    pub fn differentiate(&mut self, weights: &impl Weights<f32>, batch: &Batch) -> Gradient {
        let started = Instant::now();
        let (embeddings, embedded) = self.encoder_pass.forward(weights, batch.frames.observed());
        let encoding = started.elapsed();

        // The samples' rows of the embeddings.
        let latent = self.latent;
        let gather = |rows: &[usize]| -> Vec<f32> {
            rows.iter().flat_map(|row| &embeddings[row * latent..][..latent]).copied().collect()
        };
        let (x, x_g) = (gather(&batch.observations), gather(&batch.goals));
        let steps_left: Vec<f32> = batch.steps_left.iter().copied().map(steps_left::scaled).collect();
        let next = gather(&batch.next);
        let samples = Samples {
            x: &x,
            x_g: &x_g,
            steps_left: &steps_left,
            actions: &batch.actions,
            applied_actions: &batch.applied_actions,
            mask: &batch.mask,
            next: &next,
        };
        let outer = self.outer_loop.run(weights, samples);

        // A frame's gradient is the sum over its samples, as observation or goal.
        let mut hat = vec![0.0; embeddings.len()];
        for (rows, gradient) in [(&batch.observations, outer.x), (&batch.goals, outer.x_g)] {
            for (row, gradient) in rows.iter().zip(gradient.chunks_exact(latent)) {
                add(&mut hat[row * latent..][..latent], gradient);
            }
        }

        // The position loss of each frame.
        let mut position_loss = 0.0;
        let scale = self.losses.position as f32 / (3 * batch.positions.len()).max(1) as f32;
        for (row, position) in batch.positions.iter().enumerate() {
            for (i, position) in position.iter().enumerate() {
                let error = embeddings[row * latent + i] - position;
                position_loss += scale * error * error;
                hat[row * latent + i] += 2.0 * scale * error;
            }
        }

        let started = Instant::now();
        let in_encoder = embedded.vjp(&hat);
        Gradient {
            loss: (outer.loss + position_loss).into(),
            weights: outer.weights.into_iter().chain(in_encoder).collect(),
            encoder_seconds: (encoding + started.elapsed()).as_secs_f64(),
        }
    }
}
