//! Encoder's passes in training: forward over the frames of a batch, and backward to the weights.

use crate::config::EncoderConfig;
use crate::engine::layers::linear::Weights;
use crate::engine::networks::encoder::{Encoder, EncoderGradient, EncoderTape, GROUP};
use crate::engine::simd::element::Element;
use crate::observation::Observed;
use crate::precision::Precision;
use rayon::prelude::*;

/// The encoder's passes on several threads, with tapes that are reused from batch to batch.
#[derive(Debug)]
pub struct EncoderPass<T: Element> {
    config: EncoderConfig,
    precision: Precision,
    /// The encoder with the weights of the last forward pass.
    encoder: Option<Encoder<T>>,
    tapes: Vec<EncoderTape<T>>,
}

/// Embedded frames of a batch, for the backward pass from the gradient in their embeddings.
#[derive(Debug)]
pub struct EmbeddedFrames<'a, T: Element> {
    encoder: &'a Encoder<T>,
    frames: Vec<Observed<'a>>,
    /// Number of frames per thread.
    share: usize,
    tapes: &'a mut [EncoderTape<T>],
}

impl<T: Element> EncoderPass<T> {
    /// Passes of encoders with a valid configuration, on `threads` threads, at least one.
    pub fn new(config: EncoderConfig, precision: Precision, threads: usize) -> Self {
        Self { config, precision, encoder: None, tapes: (0..threads.max(1)).map(|_| EncoderTape::new()).collect() }
    }

    /// Embeddings of frames with the current weights, `[F, Z]`.
    pub fn forward<'a>(
        &'a mut self,
        weights: &impl Weights<T>,
        frames: Vec<Observed<'a>>,
    ) -> (Vec<T>, EmbeddedFrames<'a, T>) {
        let encoder = &*self.encoder.insert(Encoder::new(&self.config, self.precision, weights));
        let share = frames.len().div_ceil(self.tapes.len()).next_multiple_of(GROUP);
        let parts = self.tapes.par_iter_mut().zip(frames.par_chunks(share));
        let embeddings: Vec<_> = parts.map(|(tape, frames)| encoder.forward(frames, true, tape)).collect();
        (embeddings.concat(), EmbeddedFrames { encoder, frames, share, tapes: &mut self.tapes })
    }
}

impl<T: Element> EmbeddedFrames<'_, T> {
    /// The gradient by the weights' names in a checkpoint, from the gradient in the embeddings, `[F, Z]`. It is deterministic for a
    /// given number of threads.
    pub fn vjp(self, x_hat: &[T]) -> Vec<(String, Vec<T>)> {
        let Self { encoder, frames, share, tapes } = self;
        let x_hats = x_hat.par_chunks(share * encoder.latent());
        let parts = tapes.par_iter_mut().zip(frames.par_chunks(share)).zip(x_hats);
        let gradients: Vec<EncoderGradient<T>> = parts
            .map(|((tape, frames), x_hat)| {
                let mut gradient = encoder.gradient();
                encoder.vjp(frames, x_hat.to_vec(), &mut gradient, tape);
                gradient
            })
            .collect();

        // The sum over the threads, in a fixed order.
        let mut gradients = gradients.into_iter();
        let mut sum = gradients.next().unwrap_or_else(|| encoder.gradient());
        gradients.for_each(|gradient| sum.add(&gradient));
        encoder.in_weights(&sum)
    }
}
