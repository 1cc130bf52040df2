//! Queries for plans, the searches that answer them, and plans.

/// The ends of a plan: an observation's and a goal's embedding.
#[derive(Debug, Clone, Copy)]
pub struct Query<'a> {
    /// x, the observation's embedding, `[Z]`.
    pub x: &'a [f32],
    /// x_g, the goal's embedding, `[Z]`.
    pub x_g: &'a [f32],
    /// Seed of everything random in the search.
    pub seed: u64,
    /// Actions to search from, `[H][A]`; the policy's if there are none.
    pub start: &'a [Vec<f32>],
}

/// A search: its solver and its number of iterations.
pub struct Search<'a> {
    /// The solver.
    pub solver: Solver,
    /// The number of improvements.
    pub iterations: Iterations<'a>,
}

/// The end of a search.
pub enum Iterations<'a> {
    /// A fixed number of iterations.
    Fixed(usize),
    /// Iterations for as long as the answer is true.
    While(&'a mut dyn FnMut() -> bool),
}

/// Number of rollouts in a search of so many iterations: of [`Solver::Gradient`] forward and backward.
pub fn rollouts(solver: Solver, iterations: usize) -> usize {
    match solver {
        Solver::Gradient => iterations + 1,
        Solver::Cem(samples) | Solver::Mppi(samples) | Solver::Hybrid(samples) => iterations * samples + 1,
    }
}

/// Solver: a search for the actions whose predicted end is nearest to the goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Solver {
    /// Updates by backpropagation through the predicted states (section "Universal planning networks").
    Gradient,
    /// The cross-entropy method (Rubinstein, 1999): each generation of so many plans is drawn around the best of the last.
    Cem(usize),
    /// Model predictive path integral control (Williams et al., 2017): around the mean of the last, weighted by loss.
    Mppi(usize),
    /// [`Solver::Cem`] whose mean takes a step down the gradient after each generation (Bharadhwaj et al., 2020).
    Hybrid(usize),
}

/// A planned action sequence with its predicted distance to the goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// â_{t:t+H}, `[H][A]`; not clipped.
    pub actions: Vec<Vec<f32>>,
    /// The inner loss before each iteration and after the last; where a search keeps the best plan, that of the best so far.
    /// Empty for methods that do not plan.
    pub inner_losses: Vec<f32>,
    /// Number of iterations after which this plan was found.
    pub iterations: usize,
}

impl Iterations<'_> {
    /// True if another iteration follows `done`.
    pub(crate) fn go_on(&mut self, done: usize) -> bool {
        match self {
            Self::Fixed(count) => done < *count,
            Self::While(more) => more(),
        }
    }

    /// True if it is known that none follows `done`.
    pub(crate) fn ends_at(&self, done: usize) -> bool {
        matches!(self, Self::Fixed(count) if done >= *count)
    }

    /// True if the best plan counts, since it is not known which iteration is the last.
    pub(crate) fn keep_best(&self) -> bool {
        matches!(self, Self::While(_))
    }
}
