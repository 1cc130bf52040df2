//! Planner of the native engine, without an autograd graph, with memory that is reused from plan to plan.

use super::worker::{BLOCK, Dynamics, Worker};
use crate::config::{Input, ModelConfig};
use crate::engine::networks::encoder::Encoder;
use crate::familiar::FamiliarGoals;
use crate::method::Method;
use crate::model::Model;
use crate::observation::Observed;
use crate::precision::Precision;
use crate::search::ongoing::Ongoing;
use crate::search::searcher::{Chunks, Searcher, par_chunks};
use crate::search::{Plan, Query, Search};
use std::sync::Arc;

/// A learned method, with weights packed for planning, in float32. Its plans equal those of autograd with the same weights, within
/// rounding errors. A plan is bit for bit independent of the rest of the batch.
#[derive(Debug)]
pub struct Planner {
    config: ModelConfig,
    familiar: Option<FamiliarGoals>,
    encoder: Encoder<f32>,
    searcher: Searcher<Worker<f32>>,
}

impl Planner {
    /// A planner of a valid model on `threads` threads, at least one, with images embedded in `precision`.
    pub fn new(model: &Model, precision: Precision, threads: usize) -> Self {
        let Model { config, weights, familiar } = model;
        let dynamics = Arc::new(Dynamics::new(config, weights));
        let workers = (0..threads.max(1)).map(|_| Worker::new(Arc::clone(&dynamics))).collect();
        let encoder = Encoder::new(&config.encoder, precision, weights);
        Self { config: config.clone(), familiar: familiar.clone(), encoder, searcher: Searcher::new(workers) }
    }
}

impl Method for Planner {
    fn name(&self) -> &'static str {
        self.config.method.name()
    }

    fn horizon(&self) -> usize {
        self.config.horizon as usize
    }

    fn actions(&self) -> usize {
        self.config.actions as usize
    }

    fn updates(&self) -> Option<usize> {
        self.searcher.is_searchable().then_some(self.config.updates as usize)
    }

    fn takes(&self, input: Input) -> bool {
        self.config.encoder.input() == input
    }

    fn takes_steps_left(&self) -> bool {
        self.config.method.takes_steps_left()
    }

    fn encode(&mut self, inputs: &[Observed<'_>]) -> Vec<Vec<f32>> {
        let encoder = &self.encoder;
        par_chunks(self.searcher.blocks_mut(), inputs, Chunks { least: 1, size: BLOCK }, |worker, inputs| {
            let embeddings = encoder.forward(inputs, false, &mut worker.tape);
            embeddings.chunks_exact(encoder.latent()).map(<[f32]>::to_vec).collect()
        })
    }

    fn is_familiar(&self, x_g: &[f32]) -> bool {
        self.familiar.as_ref().is_some_and(|familiar| familiar.contains(x_g))
    }

    fn moves_positions(&self) -> bool {
        self.config.position_dynamics
    }

    fn plan(&mut self, queries: &[Query<'_>], search: &mut Search<'_>) -> Vec<Plan> {
        self.searcher.plan(queries, search)
    }

    fn together(&self) -> usize {
        self.searcher.together()
    }

    fn resume(&mut self, queries: &[Query<'_>], ongoing: &mut Ongoing, go_on: &mut dyn FnMut() -> bool) {
        self.searcher.resume(queries, ongoing, go_on);
    }
}
