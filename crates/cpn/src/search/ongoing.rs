//! Searches in pieces, to be suspended and resumed.

use super::descent::Descent;
use super::query::{Plan, Solver, rollouts};
use super::sampling::SamplingSearch;

/// State of a search in pieces, by [`Method::resume`](crate::Method::resume). The plans are bit for bit those of
/// [`Method::plan`](crate::Method::plan), for any division into pieces.
#[derive(Debug)]
pub struct Ongoing {
    pub(crate) solver: Solver,
    pub(crate) iterations: usize,
    pub(crate) keep_best: bool,
    pub(crate) state: State,
}

/// Progress of a search.
#[derive(Debug)]
pub(crate) enum State {
    New,
    /// One descent per thread.
    Descents(Vec<Descent>),
    Sampling(Box<SamplingSearch>),
    /// Result of a search in one piece.
    Whole(Vec<Plan>),
}

impl Ongoing {
    /// A search of `iterations`. If it may end sooner, the result is the best plan; else, for [`Solver::Gradient`], the last.
    pub fn new(solver: Solver, iterations: usize, may_end_sooner: bool) -> Self {
        Self { solver, iterations, keep_best: may_end_sooner, state: State::New }
    }

    /// The solver.
    pub fn solver(&self) -> Solver {
        self.solver
    }

    /// True after all iterations.
    pub fn is_over(&self) -> bool {
        match &self.state {
            State::New => false,
            State::Descents(descents) => descents.iter().all(|descent| descent.done >= self.iterations),
            State::Sampling(sampling) => sampling.done >= self.iterations,
            State::Whole(_) => true,
        }
    }

    /// Number of rollouts so far over all queries, a measure of the search's time.
    pub fn rollouts(&self) -> usize {
        match &self.state {
            State::New => 0,
            State::Descents(descents) => descents.iter().map(|descent| (descent.done + 1) * descent.plans.len()).sum(),
            State::Sampling(sampling) => sampling.rollouts,
            State::Whole(plans) => rollouts(self.solver, self.iterations) * plans.len(),
        }
    }

    /// Removes a query, by its index among the remaining ones.
    pub fn remove(&mut self, mut index: usize) {
        match &mut self.state {
            State::Descents(descents) => {
                for descent in descents {
                    if index < descent.plans.len() {
                        return descent.remove(index);
                    }
                    index -= descent.plans.len();
                }
            }
            State::Whole(plans) => drop(plans.remove(index)),
            State::New | State::Sampling(_) => {}
        }
    }

    /// The plans so far; empty if the search has not begun.
    pub fn into_plans(self) -> Vec<Plan> {
        match self.state {
            State::New => Vec::new(),
            State::Descents(descents) => descents.into_iter().flat_map(|descent| descent.plans).collect(),
            State::Sampling(sampling) => vec![sampling.into_plan()],
            State::Whole(plans) => plans,
        }
    }
}
