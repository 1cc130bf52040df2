//! Plans without a graph, in memory that is kept from plan to plan.

use super::descent::Descent;
use super::inner::{Actions, Purpose, Rollout};
use super::sampling::Sampling;
use crate::agent::Agent;
use crate::config::{Input, ModelConfig};
use crate::encoder::Precision;
use crate::engine::layers::linear::Weights;
use crate::engine::networks::encoder::{Encoder, EncoderTape};
use crate::engine::networks::policy_dynamics::{Buffers, PolicyDynamics};
use crate::engine::networks::variables::Variables;
use crate::engine::simd::element::Element;
use crate::method::{Iterations, Method, Observed, Ongoing, Plan, Query, Search, Solver, State};
use rayon::prelude::*;

/// R, the plans of a block: with more of them weights are read less often, with fewer what the passes leave lies nearer.
pub(super) const BLOCK: usize = 16;

/// A learned method as it is served: its weights laid out for planning, in float32. What it plans is what autograd plans from
/// the same weights ([`crate::inner_loop`]), within rounding; each plan comes out the same, bit for bit, alone or among others.
#[derive(Debug)]
pub struct Planner {
    config: ModelConfig,
    encoder: Encoder<f32>,
    dynamics: Dynamics<f32>,
    workers: Vec<Worker<f32>>,
}

/// g_θ with what its inner loop needs.
#[derive(Debug)]
pub(super) struct Dynamics<T> {
    pub(super) network: PolicyDynamics<T>,
    /// α.
    pub(super) step_size: T,
    /// H.
    pub(super) horizon: usize,
    /// Whether there is a goal to plan towards, or only a policy to ask.
    pub(super) plans: bool,
}

/// One thread's memory.
#[derive(Debug)]
pub(super) struct Worker<T: Element> {
    tape: EncoderTape<T>,
    pub(super) rollout: Rollout<T>,
    pub(super) buffers: Buffers<T>,
    /// x along a rollout, then x̄, `[R, Z]`.
    pub(super) x: Vec<T>,
    /// `[R, Z]`.
    pub(super) x_g: Vec<T>,
    /// By step, then row, `[H, R, A]`.
    pub(super) actions: Vec<T>,
    /// The descent whose last rollout this is.
    pub(super) resident: Option<u64>,
}

impl Planner {
    /// Lays out an agent's weights for plans on `threads` threads, at least one, with images embedded in this precision.
    pub fn new(agent: Agent, precision: Precision, threads: usize) -> Self {
        let (config, variables) = (agent.config().clone(), agent.variables().variables());
        let weights = &Variables(&variables);
        let dynamics = Dynamics::new(&config, weights);
        let workers = (0..threads.max(1)).map(|_| Worker::new(&dynamics)).collect();
        let encoder = Encoder::new(&config.encoder, precision, weights);
        Self { encoder, dynamics, workers, config }
    }
}

impl<T: Element> Dynamics<T> {
    fn new(config: &ModelConfig, weights: &impl Weights<T>) -> Self {
        Self {
            network: PolicyDynamics::new(config, weights),
            step_size: weights.get("step_size")[0],
            horizon: config.horizon as usize,
            plans: config.method.plans(),
        }
    }
}

impl<T: Element> Worker<T> {
    fn new(dynamics: &Dynamics<T>) -> Self {
        let sizes = dynamics.network.sizes;
        let zeros = |columns: usize| vec![T::ZERO; BLOCK * columns];
        Self {
            tape: EncoderTape::new(),
            rollout: Rollout::new(&dynamics.network, BLOCK, dynamics.horizon),
            buffers: dynamics.network.buffers(BLOCK),
            x: zeros(sizes.latent),
            x_g: zeros(sizes.latent),
            actions: zeros(dynamics.horizon * sizes.actions),
            resident: None,
        }
    }

    /// Rolls out from x along the actions, which the policy proposes or somebody has written; answers the inner losses. What
    /// is rolled out for its loss alone cannot be improved afterwards.
    /// `x` and `x_g` come row by row, `[Z]` each.
    pub(super) fn roll_out<'a>(
        &mut self,
        dynamics: &Dynamics<T>,
        (source, purpose): (Actions, Purpose),
        ends: impl Iterator<Item = (&'a [T], &'a [T])>,
    ) -> impl Iterator<Item = T> {
        let (network, latent) = (&dynamics.network, dynamics.network.sizes.latent);
        let Self { rollout, buffers, x, x_g, actions, resident, .. } = self;
        *resident = None;
        let mut rows = 0;
        for (from, to) in ends {
            x[rows * latent..][..latent].copy_from_slice(from);
            x_g[rows * latent..][..latent].copy_from_slice(to);
            rows += 1;
        }
        let ends = (&mut x[..rows * latent], &x_g[..rows * latent]);
        rollout.forward(network, ends, (source, actions), purpose, buffers);
        rollout.losses(network, rows)
    }

    /// Moves the actions of the rollout, of R = `rows` plans, a step down the inner loss.
    pub(super) fn descend(&mut self, dynamics: &Dynamics<T>, rows: usize) {
        let sizes = dynamics.network.sizes;
        let Self { rollout, buffers, x, actions, .. } = self;
        rollout.backward(&dynamics.network, &mut x[..rows * sizes.latent], buffers);
        for (action, gradient) in
            actions.iter_mut().zip(&rollout.gradient).take(dynamics.horizon * rows * sizes.actions)
        {
            *action -= dynamics.step_size * *gradient;
        }
    }

    /// Where step t of plan r of R = `rows` stands among the actions.
    pub(super) fn action(&mut self, dynamics: &Dynamics<T>, rows: usize, (t, r): (usize, usize)) -> &mut [T] {
        let size = dynamics.network.sizes.actions;
        &mut self.actions[(t * rows + r) * size..][..size]
    }
}

impl Worker<f32> {
    /// The plan of row r of R = `rows`, `[H][A]`.
    pub(super) fn plan(&mut self, dynamics: &Dynamics<f32>, rows: usize, r: usize) -> Vec<Vec<f32>> {
        (0..dynamics.horizon).map(|t| self.action(dynamics, rows, (t, r)).to_vec()).collect()
    }

    /// Writes a plan, `[H][A]`, as row r of R = `rows`.
    pub(super) fn set_plan(&mut self, dynamics: &Dynamics<f32>, rows: usize, r: usize, plan: &[Vec<f32>]) {
        self.resident = None;
        for (t, action) in plan.iter().enumerate() {
            self.action(dynamics, rows, (t, r)).copy_from_slice(action);
        }
    }

    /// Plans by updates down the inner loss, for at most [`BLOCK`] queries.
    fn by_gradient(
        &mut self,
        dynamics: &Dynamics<f32>,
        queries: &[Query<'_>],
        iterations: &mut Iterations<'_>,
    ) -> Vec<Plan> {
        let mut descent = Descent::begin(self, dynamics, queries);
        while dynamics.plans && iterations.go_on(descent.done) {
            let last = iterations.ends_at(descent.done + 1);
            descent.update(self, dynamics, queries, (last, iterations.keep_best()));
        }
        descent.plans
    }
}

/// Plans by trying plans, one query after the other: all workers try those of one.
fn by_sampling(
    workers: &mut [Worker<f32>],
    dynamics: &Dynamics<f32>,
    query: Query<'_>,
    (solver, iterations): (Solver, &mut Iterations<'_>),
) -> Plan {
    let mut sampling = Sampling::begin(&mut workers[0], dynamics, query);
    while iterations.go_on(sampling.done) {
        let done = sampling.done;
        while sampling.done == done {
            sampling.go_on(workers, dynamics, query, solver);
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
        spread(&mut self.workers, inputs, (1, BLOCK), |worker, inputs| {
            let embeddings = encoder.forward(inputs, false, &mut worker.tape);
            embeddings.chunks_exact(encoder.latent()).map(<[f32]>::to_vec).collect()
        })
    }

    fn plan(&mut self, queries: &[Query<'_>], search: &mut Search<'_>) -> Vec<Plan> {
        let (dynamics, workers, iterations) = (&self.dynamics, &mut self.workers, &mut search.iterations);
        match (search.solver, iterations) {
            (Solver::Gradient, Iterations::Fixed(count)) => {
                spread(workers, queries, (BLOCK, BLOCK), |worker, queries| {
                    worker.by_gradient(dynamics, queries, &mut Iterations::Fixed(*count))
                })
            }
            (Solver::Gradient, iterations) => {
                let block = |queries| workers[0].by_gradient(dynamics, queries, iterations);
                queries.chunks(BLOCK).flat_map(block).collect()
            }
            (solver, iterations) => {
                queries.iter().map(|query| by_sampling(workers, dynamics, *query, (solver, iterations))).collect()
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
                    descent.leave(worker, dynamics);
                    descent
                };
                let begun = workers.iter_mut().zip(queries.chunks(share)).map(begin).collect();
                ongoing.state = State::Descents(begun);
            }
            State::New => {
                ongoing.state = State::Sampling(Box::new(Sampling::begin(&mut workers[0], dynamics, queries[0])))
            }
            State::Descents(descents) => {
                let mut rest = queries;
                let mut parts: Vec<_> = workers
                    .iter_mut()
                    .zip(descents)
                    .map(|(worker, descent)| {
                        let (part, others) = rest.split_at(descent.plans.len());
                        rest = others;
                        (worker, descent, part)
                    })
                    .collect();
                loop {
                    let update = |(worker, descent, queries): &mut (&mut Worker<f32>, &mut Descent, &[Query<'_>])| {
                        let last = descent.done + 1 == count && !keep_best;
                        descent.update(worker, dynamics, queries, (last, keep_best));
                    };
                    let over = |parts: &[(&mut Worker<f32>, &mut Descent, &[Query<'_>])]| {
                        parts.iter().all(|(_, descent, _)| descent.done >= count)
                    };
                    if over(&parts) {
                        break;
                    }
                    match &mut parts[..] {
                        [one] => update(one),
                        several => several.par_iter_mut().for_each(update),
                    }
                    if over(&parts) || !go_on() {
                        break;
                    }
                }
                parts.into_iter().for_each(|(worker, descent, _)| descent.leave(worker, dynamics));
            }
            State::Sampling(sampling) => {
                while sampling.done < count {
                    sampling.go_on(workers, dynamics, queries[0], solver);
                    if !go_on() {
                        break;
                    }
                }
            }
            State::Whole(_) => {}
        }
    }
}

/// Runs over blocks of the items, on as many threads as there are workers and `least` items for each; the results in the order
/// of the items.
fn spread<I: Sync, O: Send>(
    workers: &mut [Worker<f32>],
    items: &[I],
    (least, block): (usize, usize),
    run: impl Fn(&mut Worker<f32>, &[I]) -> Vec<O> + Sync,
) -> Vec<O> {
    let share = items.len().div_ceil(workers.len()).next_multiple_of(least);
    if share >= items.len() {
        // Another thread would only have to be woken.
        return items.chunks(block).flat_map(|items| run(&mut workers[0], items)).collect();
    }
    let shares = workers.par_iter_mut().zip(items.par_chunks(share));
    let parts = shares.map(|(worker, items)| items.chunks(block).flat_map(|items| run(worker, items)).collect());
    parts.collect::<Vec<Vec<O>>>().into_iter().flatten().collect()
}
