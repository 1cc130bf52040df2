//! Settings of plans in closed loop.

use clap::{Args, ValueEnum, value_parser};
use serde::{Deserialize, Serialize};
use std::fmt;
use wire::planner::{MAX_STEPS_LEFT, Search};
use wire::{Error, proto};

/// Plans in closed loop: the search for them, and how they are carried out. By default each model searches in its own way, and
/// of each plan the first action is applied.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Args, Serialize, Deserialize)]
#[serde(default)]
pub struct Planning {
    /// Solver of the search for actions, of models that plan [default: gradient].
    #[arg(long, value_enum)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub solver: Option<Solver>,
    /// Iterations of the search: updates U of the gradient solver, generations of the others [default: the planner's].
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub updates: Option<u32>,
    /// Plans in each generation, of the solvers that sample [default: the planner's].
    #[arg(long, requires = "solver")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<u32>,
    /// Start each search from the plan before, moved on by the applied actions.
    #[arg(long)]
    pub warm_start: bool,
    /// Plan straight towards the goal, also where the hand stalls.
    #[arg(long)]
    #[serde(default = "straight")]
    pub no_approaches: bool,
    /// Number of actions of each plan that are applied before the next plan; at most the horizon.
    #[arg(long, default_value_t = 1, value_parser = value_parser!(u32).range(1..))]
    pub apply_actions: u32,
    /// Let the simulation go on at its control rate while the planner thinks: the last action is applied again at every step
    /// until the plan is there, zero before the first. A plan takes at least one step. The planner's time is the one that it
    /// reports: queueing, encoding and planning.
    #[arg(long, conflicts_with = "apply_actions")]
    pub real_time: bool,
    /// Number of steps of a task, from which the number of steps left is counted down, of models that take it; it stays 1 after
    /// these steps [default: the maximum of an episode].
    #[arg(long, value_parser = value_parser!(u32).range(1..=i64::from(MAX_STEPS_LEFT)))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task_steps: Option<u32>,
}

impl Default for Planning {
    fn default() -> Self {
        Self {
            solver: None,
            updates: None,
            samples: None,
            warm_start: false,
            no_approaches: false,
            apply_actions: 1,
            real_time: false,
            task_steps: None,
        }
    }
}

/// `no_approaches` of a record without it, from before there were approaches.
fn straight() -> bool {
    true
}

impl Planning {
    /// Whether everything is as by default.
    pub(crate) fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Settings of a record without any: the default from before there were approaches.
    pub(crate) fn of_old_record() -> Self {
        Self { no_approaches: straight(), ..Self::default() }
    }

    /// The search that models that plan are asked for; none if it is theirs.
    pub(crate) fn search(&self) -> Option<Search> {
        let Self { solver, updates, samples, .. } = *self;
        (solver.is_some() || updates.is_some() || samples.is_some()).then(|| Search {
            solver: solver.unwrap_or(Solver::Gradient).into(),
            iterations: updates,
            samples,
            anytime: false,
        })
    }

    /// Number of steps left after `step` steps of an episode of at most `max_steps`, at least one.
    pub(crate) fn steps_left(&self, max_steps: u32, step: u32) -> u32 {
        self.task_steps.unwrap_or(max_steps).saturating_sub(step).clamp(1, MAX_STEPS_LEFT)
    }

    /// Checks the search by the rules of the wire.
    ///
    /// # Errors
    /// If it would be refused.
    pub(crate) fn check(&self) -> Result<(), Error> {
        self.search().map_or(Ok(()), |search| Search::try_from(proto::Search::from(search)).map(drop))
    }
}

/// The options that were given, as they are typed.
impl fmt::Display for Planning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { solver, updates, samples, warm_start, no_approaches, apply_actions, real_time, task_steps } = self;
        let options = [
            solver.and_then(|solver| Some(format!("--solver {}", solver.to_possible_value()?.get_name()))),
            updates.map(|updates| format!("--updates {updates}")),
            samples.map(|samples| format!("--samples {samples}")),
            warm_start.then(|| "--warm-start".into()),
            no_approaches.then(|| "--no-approaches".into()),
            (*apply_actions != 1).then(|| format!("--apply-actions {apply_actions}")),
            real_time.then(|| "--real-time".into()),
            task_steps.map(|steps| format!("--task-steps {steps}")),
        ];
        let given: Vec<_> = options.into_iter().flatten().collect();
        if given.is_empty() { write!(f, "default planning") } else { write!(f, "{}", given.join(" ")) }
    }
}

/// Solvers of the search for actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Solver {
    /// Gradient descent through the predicted states.
    Gradient,
    /// Cross-entropy method.
    Cem,
    /// Model predictive path integral control.
    Mppi,
    /// Cross-entropy method with gradient steps.
    Hybrid,
}

impl From<Solver> for wire::planner::Solver {
    fn from(solver: Solver) -> Self {
        match solver {
            Solver::Gradient => Self::Gradient,
            Solver::Cem => Self::Cem,
            Solver::Mppi => Self::Mppi,
            Solver::Hybrid => Self::Hybrid,
        }
    }
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;

    #[test]
    fn records_without_settings_are_of_the_default() {
        assert_eq!(serde_json::from_str::<Planning>("{}").unwrap(), Planning::of_old_record());
        assert_eq!(Planning::of_old_record().to_string(), "--no-approaches");
        assert_eq!(Planning::default().search(), None);
        let planning = Planning { updates: Some(0), warm_start: true, task_steps: Some(70), ..Planning::default() };
        let json = serde_json::to_string(&planning).unwrap();
        assert_eq!(serde_json::from_str::<Planning>(&json).unwrap(), planning);
        assert_eq!(planning.to_string(), "--updates 0 --warm-start --task-steps 70");
        assert_eq!(planning.search().unwrap().iterations, Some(0));
    }

    #[test]
    fn a_search_that_the_planner_would_refuse_is_refused() {
        let of = |solver, updates, samples| Planning { solver, updates, samples, ..Planning::default() };
        for sound in [of(Some(Solver::Cem), Some(4), Some(64)), of(None, Some(1000), None), Planning::default()] {
            sound.check().unwrap();
        }
        for (wrong, field) in [
            (of(Some(Solver::Gradient), None, Some(64)), "samples"),
            (of(Some(Solver::Mppi), None, Some(5000)), "samples"),
            (of(None, Some(1001), None), "iterations"),
        ] {
            assert_eq!(wrong.check().unwrap_err().field, field);
        }
    }
}
