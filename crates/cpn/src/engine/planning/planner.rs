//! The planner: plans without a graph, in memory that is kept from plan to plan.

use super::descent::Descent;
use super::ongoing::{Ongoing, State};
use super::sampling_search::SamplingSearch;
use super::worker::{BLOCK, Dynamics, Worker};
use crate::agent::Agent;
use crate::config::{Input, ModelConfig};
use crate::engine::networks::encoder::Encoder;
use crate::engine::networks::variables::Variables;
use crate::method::Method;
use crate::observation::Observed;
use crate::precision::Precision;
use crate::search::{Iterations, Plan, Query, Search, Solver};
use rayon::prelude::*;

/// A learned method as it is served: its weights laid out for planning, in float32. Its plans are those of autograd from the same
/// weights ([`crate::inner_loop`]), within rounding; each plan comes out the same, bit for bit, alone or among others.
#[derive(Debug)]
pub struct Planner {
    config: ModelConfig,
    encoder: Encoder<f32>,
    dynamics: Dynamics<f32>,
    workers: Vec<Worker<f32>>,
}

impl Planner {
    /// A planner of an agent's weights on `threads` threads, at least one, with images embedded in this precision.
    pub fn new(agent: Agent, precision: Precision, threads: usize) -> Self {
        let (config, variables) = (agent.config().clone(), agent.variables().variables());
        let weights = &Variables(&variables);
        let dynamics = Dynamics::new(&config, weights);
        let workers = (0..threads.max(1)).map(|_| Worker::new(&dynamics)).collect();
        let encoder = Encoder::new(&config.encoder, precision, weights);
        Self { encoder, dynamics, workers, config }
    }
}

/// A part of a batch: a worker with its descent and the descent's queries.
struct Share<'a, 'q> {
    worker: &'a mut Worker<f32>,
    descent: &'a mut Descent,
    queries: &'a [Query<'q>],
}

/// Plans by gradient descent down the inner loss, for at most [`BLOCK`] queries.
fn by_gradient(
    worker: &mut Worker<f32>,
    dynamics: &Dynamics<f32>,
    queries: &[Query<'_>],
    iterations: &mut Iterations<'_>,
) -> Vec<Plan> {
    let mut descent = Descent::begin(worker, dynamics, queries);
    while dynamics.plans && iterations.go_on(descent.done) {
        let last = iterations.ends_at(descent.done + 1);
        descent.update(worker, dynamics, queries, last, iterations.keep_best());
    }
    descent.plans
}

/// A plan by sampling: all workers try plans for the one query.
fn by_sampling(
    workers: &mut [Worker<f32>],
    dynamics: &Dynamics<f32>,
    query: Query<'_>,
    solver: Solver,
    iterations: &mut Iterations<'_>,
) -> Plan {
    let mut sampling = SamplingSearch::begin(&mut workers[0], dynamics, query);
    while iterations.go_on(sampling.done) {
        let done = sampling.done;
        while sampling.done == done {
            sampling.advance(workers, dynamics, query, solver);
        }
    }
    sampling.into_plan()
}

impl Method for Planner {
    fn name(&self) -> &'static str {
        self.config.method.name()
    }

    fn horizon(&self) -> usize {
        self.dynamics.horizon
    }

    fn actions(&self) -> usize {
        self.dynamics.network.sizes.actions
    }

    fn updates(&self) -> Option<usize> {
        self.dynamics.plans.then_some(self.config.updates as usize)
    }

    fn takes(&self, input: Input) -> bool {
        self.config.encoder.input() == input
    }

    fn encode(&mut self, inputs: &[Observed<'_>]) -> Vec<Vec<f32>> {
        let encoder = &self.encoder;
        par_blocks(&mut self.workers, inputs, Blocks { least: 1, size: BLOCK }, |worker, inputs| {
            let embeddings = encoder.forward(inputs, false, &mut worker.tape);
            embeddings.chunks_exact(encoder.latent()).map(<[f32]>::to_vec).collect()
        })
    }

    fn plan(&mut self, queries: &[Query<'_>], search: &mut Search<'_>) -> Vec<Plan> {
        let (dynamics, workers, iterations) = (&self.dynamics, &mut self.workers, &mut search.iterations);
        match (search.solver, iterations) {
            (Solver::Gradient, Iterations::Fixed(count)) => {
                par_blocks(workers, queries, Blocks { least: BLOCK, size: BLOCK }, |worker, queries| {
                    by_gradient(worker, dynamics, queries, &mut Iterations::Fixed(*count))
                })
            }
            (Solver::Gradient, iterations) => {
                let block = |queries| by_gradient(&mut workers[0], dynamics, queries, iterations);
                queries.chunks(BLOCK).flat_map(block).collect()
            }
            (solver, iterations) => {
                queries.iter().map(|query| by_sampling(workers, dynamics, *query, solver, iterations)).collect()
            }
        }
    }

    fn together(&self) -> usize {
        BLOCK * self.workers.len()
    }

    fn resume(&mut self, queries: &[Query<'_>], ongoing: &mut Ongoing, go_on: &mut dyn FnMut() -> bool) {
        let (dynamics, workers) = (&self.dynamics, &mut self.workers[..]);
        let (solver, count, keep_best) = (ongoing.solver, ongoing.iterations, ongoing.keep_best);
        match &mut ongoing.state {
            State::New if !dynamics.plans || (solver == Solver::Gradient && queries.len() > BLOCK * workers.len()) => {
                let iterations = Iterations::Fixed(count);
                ongoing.state = State::Whole(self.plan(queries, &mut Search { solver, iterations }));
            }
            State::New if solver == Solver::Gradient => {
                let share = queries.len().div_ceil(workers.len());
                let begin = |(worker, queries): (&mut Worker<f32>, &[Query<'_>])| {
                    let mut descent = Descent::begin(worker, dynamics, queries);
                    descent.suspend(worker, dynamics);
                    descent
                };
                let begun = workers.iter_mut().zip(queries.chunks(share)).map(begin).collect();
                ongoing.state = State::Descents(begun);
            }
            State::New => {
                ongoing.state = State::Sampling(Box::new(SamplingSearch::begin(&mut workers[0], dynamics, queries[0])))
            }
            State::Descents(descents) => {
                let mut rest = queries;
                let mut shares: Vec<_> = workers
                    .iter_mut()
                    .zip(descents)
                    .map(|(worker, descent)| {
                        let (queries, others) = rest.split_at(descent.plans.len());
                        rest = others;
                        Share { worker, descent, queries }
                    })
                    .collect();

                // One update of all shares is a piece.
                let is_over = |shares: &[Share<'_, '_>]| shares.iter().all(|share| share.descent.done >= count);
                let update = |Share { worker, descent, queries }: &mut Share<'_, '_>| {
                    let last = descent.done + 1 == count && !keep_best;
                    descent.update(worker, dynamics, queries, last, keep_best);
                };
                while !is_over(&shares) {
                    match &mut shares[..] {
                        [one] => update(one),
                        several => several.par_iter_mut().for_each(update),
                    }
                    if is_over(&shares) || !go_on() {
                        break;
                    }
                }
                shares.into_iter().for_each(|share| share.descent.suspend(share.worker, dynamics));
            }
            State::Sampling(sampling) => {
                while sampling.done < count {
                    sampling.advance(workers, dynamics, queries[0], solver);
                    if !go_on() {
                        break;
                    }
                }
            }
            State::Whole(_) => {}
        }
    }
}

/// Division of items into blocks of `size`, and of the blocks among threads, with `least` items for each.
#[derive(Clone, Copy)]
struct Blocks {
    least: usize,
    size: usize,
}

/// Maps blocks of items in parallel, each thread with a multiple of `least` items but the last; returns the results in the
/// order of the items.
fn par_blocks<I: Sync, O: Send>(
    workers: &mut [Worker<f32>],
    items: &[I],
    Blocks { least, size }: Blocks,
    run: impl Fn(&mut Worker<f32>, &[I]) -> Vec<O> + Sync,
) -> Vec<O> {
    let share = items.len().div_ceil(workers.len()).next_multiple_of(least);
    if share >= items.len() {
        // Another thread would only have to be woken.
        return items.chunks(size).flat_map(|items| run(&mut workers[0], items)).collect();
    }
    let shares = workers.par_iter_mut().zip(items.par_chunks(share));
    let parts = shares.map(|(worker, items)| items.chunks(size).flat_map(|items| run(worker, items)).collect());
    parts.collect::<Vec<Vec<O>>>().into_iter().flatten().collect()
}
