//! The encoder in training: forward over the frames of a batch, and back to its weights.

use crate::config::EncoderConfig;
use crate::engine::layers::linear::Weights;
use crate::engine::networks::encoder::{Encoder, EncoderGradient, EncoderTape, GROUP};
use crate::engine::simd::element::Element;
use crate::observation::Observed;
use crate::precision::Precision;
use rayon::prelude::*;

/// Embeds frames and leads gradients back, on some threads, whose tapes are kept from batch to batch.
#[derive(Debug)]
pub struct Embedder<T: Element> {
    config: EncoderConfig,
    precision: Precision,
    /// By the weights of the last forward pass.
    encoder: Option<Encoder<T>>,
    tapes: Vec<EncoderTape<T>>,
}

/// Frames that are embedded, until it is known what a loss changes by with their embeddings.
#[derive(Debug)]
pub struct Embedded<'a, T: Element> {
    encoder: &'a Encoder<T>,
    frames: Vec<Observed<'a>>,
    /// Frames of a thread.
    share: usize,
    tapes: &'a mut [EncoderTape<T>],
}

impl<T: Element> Embedder<T> {
    /// For encoders of a valid configuration, on `threads` threads, at least one.
    pub fn new(config: EncoderConfig, precision: Precision, threads: usize) -> Self {
        Self { config, precision, encoder: None, tapes: (0..threads.max(1)).map(|_| EncoderTape::new()).collect() }
    }

    /// Embeds frames, by what the weights are now, as `[F, Z]`.
    pub fn forward<'a>(
        &'a mut self,
        weights: &impl Weights<T>,
        frames: Vec<Observed<'a>>,
    ) -> (Vec<T>, Embedded<'a, T>) {
        let encoder = &*self.encoder.insert(Encoder::new(&self.config, self.precision, weights));
        let share = frames.len().div_ceil(self.tapes.len()).next_multiple_of(GROUP);
        let parts = self.tapes.par_iter_mut().zip(frames.par_chunks(share));
        let embeddings: Vec<_> = parts.map(|(tape, frames)| encoder.forward(frames, true, tape)).collect();
        (embeddings.concat(), Embedded { encoder, frames, share, tapes: &mut self.tapes })
    }
}

impl<T: Element> Embedded<'_, T> {
    /// From a loss' gradient in the embeddings, `[F, Z]`, to that in each weight by its name in a checkpoint. The order of its
    /// sums depends on nothing but the frames and the number of threads.
    pub fn adjoint(self, x_hat: &[T]) -> Vec<(String, Vec<T>)> {
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
        let mut gradients = gradients.into_iter();
        let mut sum = gradients.next().unwrap_or_else(|| encoder.gradient());
        gradients.for_each(|gradient| sum.add(&gradient));
        encoder.in_weights(&sum)
    }
}
