//! Embeddings of a batch's frames, and the way back from them to the encoder's weights.

use crate::agent::Agent;
use crate::config::{Input, ModelConfig};
use crate::encoder::Precision;
use crate::fused::{Embedded, Embedder, Variables, floats};
use crate::method::Frames;
use std::collections::HashMap;
use tch::{Kind, Tensor};

/// Embeds frames: in float32 without a graph, in bfloat16 by autograd.
#[derive(Debug)]
pub struct FrameEncoder {
    embedder: Embedder<f32>,
    precision: Precision,
}

/// From embeddings to the encoder's weights.
#[derive(Debug)]
pub enum WayBack<'a> {
    /// Without a graph.
    Fused(Embedded<'a, f32>),
    /// By the graph of the embeddings.
    Autograd(Tensor),
}

impl FrameEncoder {
    /// For agents of a valid configuration, on some threads.
    pub fn new(config: &ModelConfig, precision: Precision, threads: usize) -> Self {
        // There is little to multiply for a position.
        let precision = if config.encoder.input() == Input::Position { Precision::Float32 } else { precision };
        Self { embedder: Embedder::new(config.encoder.clone(), threads), precision }
    }

    /// Embeds frames as `[F, Z]`; `variables` are the agent's.
    pub fn embed<'a>(
        &'a mut self,
        agent: &Agent,
        variables: &HashMap<String, Tensor>,
        frames: &'a Frames,
    ) -> (Vec<f32>, WayBack<'a>) {
        if self.precision == Precision::Bfloat16 {
            let embeddings = agent.encoder().encode_in_bfloat16(&frames.tensor());
            return (floats(&embeddings.detach()), WayBack::Autograd(embeddings));
        }
        let (embeddings, embedded) = self.embedder.forward(&Variables(variables), frames.observed());
        (embeddings, WayBack::Fused(embedded))
    }
}

impl WayBack<'_> {
    /// From a loss' gradient in the embeddings, `[F, Z]`, to that in each weight by its name.
    pub fn adjoint(self, variables: &HashMap<String, Tensor>, hat: &[f32]) -> Vec<(String, Vec<f32>)> {
        match self {
            Self::Fused(embedded) => embedded.adjoint(hat),
            Self::Autograd(embeddings) => {
                // Autograd is told the gradient in the embeddings by a sum that has it.
                let sum = (&embeddings * Tensor::from_slice(hat).view_as(&embeddings)).sum(None::<Kind>);
                let (names, weights): (Vec<_>, Vec<_>) =
                    variables.iter().filter(|(name, _)| name.starts_with("encoder.")).unzip();
                let gradients = Tensor::run_backward(&[sum], &weights, false, false);
                names.into_iter().cloned().zip(gradients.iter().map(floats)).collect()
            }
        }
    }
}
