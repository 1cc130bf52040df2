//! The compared methods behind one interface (section "Methods for comparison").

use crate::config::Input;
use crate::engine::{Descent, Sampling};
use crate::{images, positions};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::Tensor;

/// Anything that turns an observation and a goal into actions. Model predictive control applies the first action of each
/// plan and plans anew.
pub trait Method: Send {
    /// Short name of the method: `random`, `bc`, `te-bc`, `upn` or `cpn`.
    fn name(&self) -> &'static str;

    /// H, the number of actions in a plan.
    fn horizon(&self) -> usize;

    /// A, the numbers of an action.
    fn actions(&self) -> usize;

    /// U, the updates of a plan that it was trained with; none if it does not predict where actions lead, so that there is
    /// nothing to search.
    fn updates(&self) -> Option<usize>;

    /// Whether observations and goals of this kind can be embedded.
    fn takes(&self, input: Input) -> bool;

    /// Embeds observations or goals of the kind it takes, each as `[Z]`; Z is 0 for a method that does not look. An embedding
    /// does not depend on what else is embedded.
    fn encode(&mut self, inputs: &[Observed<'_>]) -> Vec<Vec<f32>>;

    /// Plans for each query, all by the same search. A plan does not depend, in any bit, on what else is planned for.
    fn plan(&mut self, queries: &[Query<'_>], search: &mut Search<'_>) -> Vec<Plan>;

    /// Most queries that [`Method::resume`] takes together, for [`Solver::Gradient`]; for the other solvers it is one.
    fn together(&self) -> usize {
        1
    }

    /// Goes on with a search for queries, always the same, until it is over or `go_on`, which is asked after each piece, says no;
    /// at least one piece is done. The first is where the search begins, and `go_on` is not asked after it. A method that knows no
    /// pieces does all at once.
    fn resume(&mut self, queries: &[Query<'_>], ongoing: &mut Ongoing, _go_on: &mut dyn FnMut() -> bool) {
        let iterations = Iterations::Fixed(ongoing.iterations);
        ongoing.state = State::Whole(self.plan(queries, &mut Search { solver: ongoing.solver, iterations }));
    }
}

/// An observation or a goal.
#[derive(Debug, Clone, Copy)]
pub enum Observed<'a> {
    /// RGB8, `[84, 84, 3]`.
    Image(&'a [u8]),
    /// x, y, z in metres.
    Position([f32; 3]),
}

/// Observations and goals, one after the other.
#[derive(Debug, Clone, PartialEq)]
pub enum Frames {
    /// RGB8, `[F, 84, 84, 3]`.
    Images(Vec<u8>),
    /// x, y, z in metres, `[F, 3]`.
    Positions(Vec<[f32; 3]>),
}

impl Frames {
    /// Each by itself. What follows the last whole image is left out.
    pub fn observed(&self) -> Vec<Observed<'_>> {
        match self {
            Self::Images(bytes) => bytes.chunks_exact(images::BYTES).map(Observed::Image).collect(),
            Self::Positions(metres) => metres.iter().copied().map(Observed::Position).collect(),
        }
    }

    /// All in one, as [`Encoder::encode`](crate::encoder::Encoder::encode) takes them.
    ///
    /// # Panics
    /// If the bytes are not a whole, non-zero number of images.
    pub fn tensor(&self) -> Tensor {
        match self {
            Self::Images(bytes) => images::from_bytes(bytes).expect("whole images, and at least one"),
            Self::Positions(metres) => positions::from_metres(metres),
        }
    }
}

/// From where to where.
#[derive(Debug, Clone, Copy)]
pub struct Query<'a> {
    /// x, the observation's embedding, `[Z]`.
    pub x: &'a [f32],
    /// x_g, the goal's embedding, `[Z]`.
    pub x_g: &'a [f32],
    /// Drives whatever is random.
    pub seed: u64,
    /// Actions to search from, `[H][A]`; the policy's if there are none.
    pub start: &'a [Vec<f32>],
}

/// How plans are searched for.
pub struct Search<'a> {
    /// Which way.
    pub solver: Solver,
    /// How many times they are improved.
    pub iterations: Iterations<'a>,
}

/// When a search ends.
pub enum Iterations<'a> {
    /// After so many.
    Fixed(usize),
    /// Once the answer is no.
    While(&'a mut dyn FnMut() -> bool),
}

/// A search that can be left and taken up again, by [`Method::resume`]. In which pieces it is done changes no bit of the plans,
/// which are those of [`Method::plan`].
#[derive(Debug)]
pub struct Ongoing {
    pub(crate) solver: Solver,
    pub(crate) iterations: usize,
    pub(crate) keep_best: bool,
    pub(crate) state: State,
}

/// How far a search has come.
#[derive(Debug)]
pub(crate) enum State {
    New,
    /// One for each thread.
    Descents(Vec<Descent>),
    Sampling(Box<Sampling>),
    /// It was done at once.
    Whole(Vec<Plan>),
}

impl Ongoing {
    /// A search of so many iterations. If it may end sooner, the best plan counts, else the last of [`Solver::Gradient`].
    pub fn new(solver: Solver, iterations: usize, may_end_sooner: bool) -> Self {
        Self { solver, iterations, keep_best: may_end_sooner, state: State::New }
    }

    /// Which way it is searched.
    pub fn solver(&self) -> Solver {
        self.solver
    }

    /// Whether all iterations were made.
    pub fn is_over(&self) -> bool {
        match &self.state {
            State::New => false,
            State::Descents(descents) => descents.iter().all(|descent| descent.done >= self.iterations),
            State::Sampling(sampling) => sampling.done >= self.iterations,
            State::Whole(_) => true,
        }
    }

    /// Rollouts so far, of all queries together: what a search takes grows with them.
    pub fn rollouts(&self) -> usize {
        match &self.state {
            State::New => 0,
            State::Descents(descents) => descents.iter().map(|descent| (descent.done + 1) * descent.plans.len()).sum(),
            State::Sampling(sampling) => sampling.rollouts,
            State::Whole(plans) => rollouts(self.solver, self.iterations) * plans.len(),
        }
    }

    /// Leaves out a query, by its place among those that are left.
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

    /// The plans so far; none of a search that was not begun.
    pub fn into_plans(self) -> Vec<Plan> {
        match self.state {
            State::New => Vec::new(),
            State::Descents(descents) => descents.into_iter().flat_map(|descent| descent.plans).collect(),
            State::Sampling(sampling) => vec![sampling.into_plan()],
            State::Whole(plans) => plans,
        }
    }
}

/// Rollouts that a search of so many iterations makes: of [`Solver::Gradient`] there and back.
pub fn rollouts(solver: Solver, iterations: usize) -> usize {
    match solver {
        Solver::Gradient => iterations + 1,
        Solver::Cem(samples) | Solver::Mppi(samples) | Solver::Hybrid(samples) => iterations * samples + 1,
    }
}

/// Ways to search for the actions whose predicted end is nearest to the goal.
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

/// A planned action sequence and how close it is predicted to come.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// â_{t:t+H}, `[H][A]`; not clipped.
    pub actions: Vec<Vec<f32>>,
    /// The inner loss before each iteration and after the last; where a search keeps the best plan, that of the best so far.
    /// Empty for methods that do not plan.
    pub inner_losses: Vec<f32>,
    /// Iterations after which this plan was found.
    pub iterations: usize,
}

impl Iterations<'_> {
    /// Whether there is to be another after `done`.
    pub(crate) fn go_on(&mut self, done: usize) -> bool {
        match self {
            Self::Fixed(count) => done < *count,
            Self::While(more) => more(),
        }
    }

    /// Whether it is known that there is to be none after `done`.
    pub(crate) fn ends_at(&self, done: usize) -> bool {
        matches!(self, Self::Fixed(count) if done >= *count)
    }

    /// Whether the best plan counts, for nobody knows which will be the last.
    pub(crate) fn keep_best(&self) -> bool {
        matches!(self, Self::While(_))
    }
}

/// The control of every comparison: uniform actions in [-1, 1], whatever the images show.
#[derive(Debug)]
pub struct Random {
    /// A, the number of continuous actions.
    pub actions: usize,
}

impl Method for Random {
    fn name(&self) -> &'static str {
        "random"
    }

    fn horizon(&self) -> usize {
        1
    }

    fn actions(&self) -> usize {
        self.actions
    }

    fn updates(&self) -> Option<usize> {
        None
    }

    fn takes(&self, _input: Input) -> bool {
        true
    }

    fn encode(&mut self, inputs: &[Observed<'_>]) -> Vec<Vec<f32>> {
        vec![Vec::new(); inputs.len()]
    }

    fn plan(&mut self, queries: &[Query<'_>], _search: &mut Search<'_>) -> Vec<Plan> {
        let plan = |query: &Query<'_>| {
            let mut rng = ChaCha8Rng::seed_from_u64(query.seed);
            let action = (0..self.actions).map(|_| rng.random_range(-1.0..=1.0)).collect();
            Plan { actions: vec![action], inner_losses: Vec::new(), iterations: 0 }
        };
        queries.iter().map(plan).collect()
    }
}
