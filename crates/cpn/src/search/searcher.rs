//! Searches over blocks of plans, at once or in pieces, on one thread or several.

use super::block::PlanBlock;
use super::descent::Descent;
use super::ongoing::{Ongoing, State};
use super::query::{Iterations, Plan, Query, Search, Solver};
use super::sampling::SamplingSearch;
use rayon::prelude::*;

/// Searches for plans, with a block of plans for each thread.
#[derive(Debug)]
pub struct Searcher<B> {
    blocks: Vec<B>,
}

/// A part of a batch: a block with its descent and the descent's queries.
struct Share<'a, 'q, B> {
    block: &'a mut B,
    descent: &'a mut Descent,
    queries: &'a [Query<'q>],
}

impl<B: PlanBlock> Searcher<B> {
    /// A searcher with one block or more, all of one model.
    pub fn new(blocks: Vec<B>) -> Self {
        Self { blocks }
    }

    /// The blocks, one a thread.
    pub fn blocks_mut(&mut self) -> &mut [B] {
        &mut self.blocks
    }

    /// True if the method's plans can be searched for.
    pub fn is_searchable(&self) -> bool {
        self.blocks[0].is_searchable()
    }

    /// Maximum number of queries that [`Self::resume`] takes together, for [`Solver::Gradient`].
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
        let is_whole = !self.is_searchable() || (solver == Solver::Gradient && queries.len() > self.together());
        let blocks = &mut self.blocks[..];
        match &mut ongoing.state {
            State::New if is_whole => {
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

                // One update of all shares is a piece.
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

/// Plans by gradient descent down the inner loss, for at most a block's capacity of queries.
fn by_gradient<B: PlanBlock>(block: &mut B, queries: &[Query<'_>], iterations: &mut Iterations<'_>) -> Vec<Plan> {
    let mut descent = Descent::begin(block, queries);
    while block.is_searchable() && iterations.go_on(descent.done) {
        let last = iterations.ends_at(descent.done + 1);
        descent.update(block, queries, last, iterations.keep_best());
    }
    descent.plans
}

/// A plan by sampling: all blocks try plans for the one query.
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

/// Maps chunks of items in parallel, each thread with a multiple of `least` items but the last; returns the results in the order of
/// the items.
pub fn par_chunks<B: Send, I: Sync, O: Send>(
    blocks: &mut [B],
    items: &[I],
    Chunks { least, size }: Chunks,
    run: impl Fn(&mut B, &[I]) -> Vec<O> + Sync,
) -> Vec<O> {
    let share = items.len().div_ceil(blocks.len()).next_multiple_of(least);
    if share >= items.len() {
        // Another thread would only have to be woken.
        return items.chunks(size).flat_map(|items| run(&mut blocks[0], items)).collect();
    }
    let shares = blocks.par_iter_mut().zip(items.par_chunks(share));
    let parts = shares.map(|(block, items)| items.chunks(size).flat_map(|items| run(block, items)).collect());
    parts.collect::<Vec<Vec<O>>>().into_iter().flatten().collect()
}
