//! The compared methods behind one interface (section "Methods for comparison").

use crate::config::Input;
use crate::search::ongoing::State;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub use crate::observation::{Frames, Observed};
pub use crate::search::ongoing::Ongoing;
pub use crate::search::{Iterations, Plan, Query, Search, Solver, rollouts};

/// A method of control: from an observation and a goal to actions. Model predictive control applies the first action of each
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

    /// True if observations and goals of this kind can be embedded.
    fn takes(&self, input: Input) -> bool;

    /// Embeddings of observations or goals of the kind it takes, `[Z]` each; Z is 0 for a method that does not look. An embedding
    /// does not depend on what else is embedded.
    fn encode(&mut self, inputs: &[Observed<'_>]) -> Vec<Vec<f32>>;

    /// A plan for each query, all by the same search. A plan does not depend, in any bit, on what else is planned for.
    fn plan(&mut self, queries: &[Query<'_>], search: &mut Search<'_>) -> Vec<Plan>;

    /// Maximum number of queries that [`Method::resume`] takes together, for [`Solver::Gradient`]; for the other solvers it is one.
    fn together(&self) -> usize {
        1
    }

    /// One or more pieces of a search for queries, always the same, until the search is over or `go_on`, called after each piece,
    /// returns false. The first piece is the search's beginning, and `go_on` is not called after it. A method without pieces does
    /// all at once.
    fn resume(&mut self, queries: &[Query<'_>], ongoing: &mut Ongoing, _go_on: &mut dyn FnMut() -> bool) {
        let iterations = Iterations::Fixed(ongoing.iterations);
        ongoing.state = State::Whole(self.plan(queries, &mut Search { solver: ongoing.solver, iterations }));
    }
}

/// The control of every comparison: uniform actions in [-1, 1], independent of the images.
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
