//! Searches for plans.

use crate::{Error, proto};

/// Largest number of iterations in a request.
pub const MAX_ITERATIONS: u32 = 1000;
/// Largest number of samples per iteration.
const MAX_SAMPLES: u32 = 4096;

/// Search for the actions whose predicted last latent is nearest to the goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Search {
    /// Optimiser.
    pub solver: Solver,
    /// Iterations: gradient updates, or generations of samples; the model's default if none.
    pub iterations: Option<u32>,
    /// Sampled plans per iteration; the default if none.
    pub samples: Option<u32>,
    /// Anytime search: iterate until shortly before the deadline.
    pub anytime: bool,
}

/// Optimisers of plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Solver {
    /// Gradient-based shooting: backpropagation through the predicted latents.
    Gradient,
    /// Cross-entropy method.
    Cem,
    /// Model predictive path integral control.
    Mppi,
    /// CEM with a gradient step of the mean after each iteration.
    Hybrid,
}

impl TryFrom<proto::Search> for Search {
    type Error = Error;

    fn try_from(search: proto::Search) -> Result<Self, Error> {
        let solver = match proto::Solver::try_from(search.solver) {
            Ok(proto::Solver::Gradient) => Solver::Gradient,
            Ok(proto::Solver::Cem) => Solver::Cem,
            Ok(proto::Solver::Mppi) => Solver::Mppi,
            Ok(proto::Solver::Hybrid) => Solver::Hybrid,
            Ok(proto::Solver::Unspecified) | Err(_) => {
                return Err(Error::invalid("solver", "GRADIENT, CEM, MPPI or HYBRID", search.solver));
            }
        };
        let samples = at_most("samples", MAX_SAMPLES, search.samples)?;
        if solver == Solver::Gradient && samples.is_some() {
            return Err(Error::invalid("samples", "none for GRADIENT", search.samples));
        }
        if samples == Some(1) {
            return Err(Error::invalid("samples", format!("2 to {MAX_SAMPLES}, or 0"), 1));
        }
        at_most("iterations", MAX_ITERATIONS, search.iterations.unwrap_or_default())?;
        Ok(Self { solver, iterations: search.iterations, samples, anytime: search.anytime })
    }
}

impl From<Search> for proto::Search {
    fn from(search: Search) -> Self {
        let solver = match search.solver {
            Solver::Gradient => proto::Solver::Gradient,
            Solver::Cem => proto::Solver::Cem,
            Solver::Mppi => proto::Solver::Mppi,
            Solver::Hybrid => proto::Solver::Hybrid,
        };
        Self {
            solver: solver.into(),
            iterations: search.iterations,
            samples: search.samples.unwrap_or_default(),
            anytime: search.anytime,
        }
    }
}

/// Validates a number with an upper bound; 0 stands for none.
fn at_most(field: &str, most: u32, value: u32) -> Result<Option<u32>, Error> {
    if value > most {
        return Err(Error::invalid(field, format!("at most {most}"), value));
    }
    Ok((value > 0).then_some(value))
}
