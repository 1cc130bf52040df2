//! Searches in pieces.

use super::descent::Descent;
use super::query::{Plan, Solver, rollouts};
use super::sampling::SamplingSearch;

/// A search in pieces, by [`Method::resume`](crate::Method::resume). The division into pieces changes no bit of the plans, which
/// are those of [`Method::plan`](crate::Method::plan).
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
    /// A descent for each thread.
    Descents(Vec<Descent>),
    Sampling(Box<SamplingSearch>),
    /// A search that was done at once.
    Whole(Vec<Plan>),
}

impl Ongoing {
    /// A search of so many iterations. If it may end sooner, the best plan counts, else the last of [`Solver::Gradient`].
    pub fn new(solver: Solver, iterations: usize, may_end_sooner: bool) -> Self {
        Self { solver, iterations, keep_best: may_end_sooner, state: State::New }
    }

    /// The solver.
    pub fn solver(&self) -> Solver {
        self.solver
    }

    /// True if all iterations were made.
    pub fn is_over(&self) -> bool {
        match &self.state {
            State::New => false,
            State::Descents(descents) => descents.iter().all(|descent| descent.done >= self.iterations),
            State::Sampling(sampling) => sampling.done >= self.iterations,
            State::Whole(_) => true,
        }
    }

    /// Number of rollouts so far, of all queries together: a search's time grows with it.
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

    /// The plans so far; none if the search has not begun.
    pub fn into_plans(self) -> Vec<Plan> {
        match self.state {
            State::New => Vec::new(),
            State::Descents(descents) => descents.into_iter().flat_map(|descent| descent.plans).collect(),
            State::Sampling(sampling) => vec![sampling.into_plan()],
            State::Whole(plans) => plans,
        }
    }
}
