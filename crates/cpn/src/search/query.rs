//! Queries for plans, settings of their search, and plans.

/// Input of a search: embeddings of an observation and a goal, number of steps left, seed, initial actions, and whether they are
/// kept.
#[derive(Debug, Clone, Copy)]
pub struct Query<'a> {
    /// x, the observation's embedding, `[Z]`.
    pub x: &'a [f32],
    /// x_g, the goal's embedding, `[Z]`.
    pub x_g: &'a [f32],
    /// Number of steps left to the goal; ignored by methods that do not take it.
    pub steps_left: u32,
    /// Seed of the search's random numbers.
    pub seed: u64,
    /// Initial actions, `[H][A]`; the policy's if empty.
    pub start: &'a [Vec<f32>],
    /// True if the result of gradient updates is the initial plan, as if none were better; ignored by solvers that sample.
    pub keep_initial: bool,
}

/// A search: its solver and its number of iterations.
pub struct Search<'a> {
    /// The solver.
    pub solver: Solver,
    /// The number of iterations.
    pub iterations: Iterations<'a>,
}

/// Number of a search's iterations.
pub enum Iterations<'a> {
    /// A fixed number of iterations.
    Fixed(usize),
    /// Iterations until the function returns false.
    While(&'a mut dyn FnMut() -> bool),
}

/// Number of rollouts in a search of `iterations`; for [`Solver::Gradient`] each is forward and backward.
pub fn rollouts(solver: Solver, iterations: usize) -> usize {
    match solver {
        Solver::Gradient => iterations + 1,
        Solver::Cem(samples) | Solver::Mppi(samples) | Solver::Hybrid(samples) => iterations * samples + 1,
    }
}

/// Solver: minimisation of the inner loss over action sequences.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Solver {
    /// Gradient descent by backpropagation through the predicted states (section "Universal planning networks").
    Gradient,
    /// Cross-entropy method (Rubinstein, 1999), with the number of plans in a generation: the distribution is fitted to the elites
    /// of each generation.
    Cem(usize),
    /// Model predictive path integral control (Williams et al., 2017), with the number of plans in a generation: the mean is the
    /// average of each generation, weighted by loss.
    Mppi(usize),
    /// [`Solver::Cem`] with a gradient step of the mean after each generation (Bharadhwaj et al., 2020).
    Hybrid(usize),
}

/// A planned action sequence with its inner losses.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// â_{t:t+H}, `[H][A]`; not clipped.
    pub actions: Vec<Vec<f32>>,
    /// Inner loss before each iteration and after the last; of the best plan so far where a search keeps it, and of the initial
    /// plan where that is kept. Empty for methods that do not plan.
    pub inner_losses: Vec<f32>,
    /// Number of iterations before this plan was found.
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

    /// True if the number of iterations is fixed and reached by `done`.
    pub(crate) fn ends_at(&self, done: usize) -> bool {
        matches!(self, Self::Fixed(count) if done >= *count)
    }

    /// True if the result is the best plan rather than the last: the last iteration is not known in advance.
    pub(crate) fn keep_best(&self) -> bool {
        matches!(self, Self::While(_))
    }
}
