//! The compared methods behind one interface (section "Methods for comparison").

use crate::config::Input;
use crate::search::ongoing::State;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub use crate::observation::{Frames, Observed};
pub use crate::search::ongoing::Ongoing;
pub use crate::search::{Iterations, Plan, Query, Search, Solver, rollouts};

/// A control policy: from embeddings of an observation and a goal to a plan of actions. Model predictive control applies the first
/// action of each plan, and plans again at the next step.
pub trait Method: Send {
    /// Short name of the method: `random`, `bc`, `te-bc`, `te-bc-horizon`, `upn` or `cpn`.
    fn name(&self) -> &'static str;

    /// H, the planning horizon.
    fn horizon(&self) -> usize;

    /// A, the number of continuous actions.
    fn actions(&self) -> usize;

    /// U, the number of updates of a plan in training; `None` for a method without predicted states, which no search can
    /// improve.
    fn updates(&self) -> Option<usize>;

    /// True if observations and goals of this kind can be embedded.
    fn takes(&self, input: Input) -> bool;

    /// True if plans depend on [`Query::steps_left`].
    fn takes_steps_left(&self) -> bool {
        false
    }

    /// Embeddings of observations or goals of a kind that it takes, `[Z]` each; Z is 0 for a method that ignores them. An embedding
    /// does not depend on the rest of the batch.
    fn encode(&mut self, inputs: &[Observed<'_>]) -> Vec<Vec<f32>>;

    /// True if a goal's embedding, `[Z]`, is near that of a training goal, so that the policy's plan is expected to be better without
    /// updates.
    fn is_familiar(&self, _x_g: &[f32]) -> bool {
        false
    }

    /// True if the first three elements of embeddings are the hand's position, which updates move (position dynamics).
    fn moves_positions(&self) -> bool {
        false
    }

    /// A plan for each query, all by the same search. A plan does not depend on the rest of the batch: in
    /// any bit natively, within rounding by libtorch.
    fn plan(&mut self, queries: &[Query<'_>], search: &mut Search<'_>) -> Vec<Plan>;

    /// Maximum batch size of [`Method::resume`] for [`Solver::Gradient`]; for the other solvers it is one.
    fn together(&self) -> usize {
        1
    }

    /// One or more pieces of a search, until it is over or `go_on`, called after each piece, returns false. The queries must be the
    /// same in every call. The first call computes the first piece alone, without a call of `go_on`. A method that cannot be
    /// suspended computes the whole search at once.
    fn resume(&mut self, queries: &[Query<'_>], ongoing: &mut Ongoing, _go_on: &mut dyn FnMut() -> bool) {
        let iterations = Iterations::Fixed(ongoing.iterations);
        ongoing.state = State::Whole(self.plan(queries, &mut Search { solver: ongoing.solver, iterations }));
    }
}

/// Random baseline of the comparison: uniform actions in [-1, 1], independent of the images.
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
