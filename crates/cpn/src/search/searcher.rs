//! Searches over blocks of plans, in one or more pieces, on one or more threads.

use super::block::PlanBlock;
use super::descent::Descent;
use super::ongoing::{Ongoing, State};
use super::query::{Iterations, Plan, Query, Search, Solver};
use super::sampling::SamplingSearch;
use rayon::prelude::*;

/// Runner of searches, with one block of plans per thread.
#[derive(Debug)]
pub struct Searcher<B> {
    blocks: Vec<B>,
}

/// A thread's part of a batch: a block, its descent and the descent's queries.
struct Share<'a, 'q, B> {
    block: &'a mut B,
    descent: &'a mut Descent,
    queries: &'a [Query<'q>],
}

impl<B: PlanBlock> Searcher<B> {
    /// A searcher with one or more blocks of one model.
    pub fn new(blocks: Vec<B>) -> Self {
        Self { blocks }
    }

    /// The blocks, one per thread.
    pub fn blocks_mut(&mut self) -> &mut [B] {
        &mut self.blocks
    }

    /// True if the method's plans have an inner loss, as [`PlanBlock::is_searchable`].
    pub fn is_searchable(&self) -> bool {
        self.blocks[0].is_searchable()
    }

    /// Maximum batch size of [`Self::resume`] for [`Solver::Gradient`].
    pub fn together(&self) -> usize {
        self.blocks[0].capacity() * self.blocks.len()
    }

    /// A plan for each query, all by the same search.
    pub fn plan(&mut self, queries: &[Query<'_>], search: &mut Search<'_>) -> Vec<Plan> {
        let size = self.blocks[0].capacity();
        match (search.solver, &mut search.iterations) {
            (Solver::Gradient, Iterations::Fixed(count)) => {
                par_chunks(&mut self.blocks, queries, Chunks { least: size, size }, |block, queries| {
                    by_gradient(block, queries, &mut Iterations::Fixed(*count))
                })
            }
            (Solver::Gradient, iterations) => {
                let block = |queries| by_gradient(&mut self.blocks[0], queries, iterations);
                queries.chunks(size).flat_map(block).collect()
            }
            (solver, iterations) => {
                queries.iter().map(|query| by_sampling(&mut self.blocks, *query, solver, iterations)).collect()
            }
        }
    }

    /// One or more pieces of a search, as [`Method::resume`](crate::Method::resume).
    pub fn resume(&mut self, queries: &[Query<'_>], ongoing: &mut Ongoing, go_on: &mut dyn FnMut() -> bool) {
        let (solver, count, keep_best) = (ongoing.solver, ongoing.iterations, ongoing.keep_best);
        let in_one_piece = !self.is_searchable() || (solver == Solver::Gradient && queries.len() > self.together());
        let blocks = &mut self.blocks[..];
        match &mut ongoing.state {
            State::New if in_one_piece => {
                let iterations = Iterations::Fixed(count);
                ongoing.state = State::Whole(self.plan(queries, &mut Search { solver, iterations }));
            }
            State::New if solver == Solver::Gradient => {
                let share = queries.len().div_ceil(blocks.len());
                let begin = |(block, queries): (&mut B, &[Query<'_>])| {
                    let mut descent = Descent::begin(block, queries);
                    descent.suspend(block);
                    descent
                };
                let begun = blocks.iter_mut().zip(queries.chunks(share)).map(begin).collect();
                ongoing.state = State::Descents(begun);
            }
            State::New => ongoing.state = State::Sampling(Box::new(SamplingSearch::begin(&mut blocks[0], queries[0]))),
            State::Descents(descents) => {
                let mut rest = queries;
                let mut shares: Vec<_> = blocks
                    .iter_mut()
                    .zip(descents)
                    .map(|(block, descent)| {
                        let (queries, others) = rest.split_at(descent.plans.len());
                        rest = others;
                        Share { block, descent, queries }
                    })
                    .collect();

                // A piece is one update of all shares.
                let is_over = |shares: &[Share<'_, '_, B>]| shares.iter().all(|share| share.descent.done >= count);
                let update = |Share { block, descent, queries }: &mut Share<'_, '_, B>| {
                    let last = descent.done + 1 == count && !keep_best;
                    descent.update(*block, queries, last, keep_best);
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
                shares.into_iter().for_each(|share| share.descent.suspend(share.block));
            }
            State::Sampling(sampling) => {
                while sampling.done < count {
                    sampling.advance(blocks, queries[0], solver);
                    if !go_on() {
                        break;
                    }
                }
            }
            State::Whole(_) => {}
        }
    }
}

/// Plans by gradient descent on the inner loss, for at most a block's capacity of queries.
fn by_gradient<B: PlanBlock>(block: &mut B, queries: &[Query<'_>], iterations: &mut Iterations<'_>) -> Vec<Plan> {
    let mut descent = Descent::begin(block, queries);
    while block.is_searchable() && iterations.go_on(descent.done) {
        let last = iterations.ends_at(descent.done + 1);
        descent.update(block, queries, last, iterations.keep_best());
    }
    descent.plans
}

/// A plan by a sampling-based search, with all blocks for one query.
fn by_sampling<B: PlanBlock>(
    blocks: &mut [B],
    query: Query<'_>,
    solver: Solver,
    iterations: &mut Iterations<'_>,
) -> Plan {
    let mut sampling = SamplingSearch::begin(&mut blocks[0], query);
    while iterations.go_on(sampling.done) {
        let done = sampling.done;
        while sampling.done == done {
            sampling.advance(blocks, query, solver);
        }
    }
    sampling.into_plan()
}

/// Division of items into chunks of `size`, and of the chunks among threads, with `least` items for each.
#[derive(Debug, Clone, Copy)]
pub struct Chunks {
    /// Minimum number of items of a thread.
    pub least: usize,
    /// Maximum number of items of a chunk.
    pub size: usize,
}

/// Maps chunks of items in parallel, and returns the results in the order of the items. Each thread but the last gets a multiple of
/// `least` items.
pub fn par_chunks<B: Send, I: Sync, O: Send>(
    blocks: &mut [B],
    items: &[I],
    Chunks { least, size }: Chunks,
    run: impl Fn(&mut B, &[I]) -> Vec<O> + Sync,
) -> Vec<O> {
    let share = items.len().div_ceil(blocks.len()).next_multiple_of(least);
    if share >= items.len() {
        // One block suffices: waking another thread costs more than it saves.
        return items.chunks(size).flat_map(|items| run(&mut blocks[0], items)).collect();
    }
    let shares = blocks.par_iter_mut().zip(items.par_chunks(share));
    let parts = shares.map(|(block, items)| items.chunks(size).flat_map(|items| run(block, items)).collect());
    parts.collect::<Vec<Vec<O>>>().into_iter().flatten().collect()
}
