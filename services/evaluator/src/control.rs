//! Controls beside the models: policies that look at nothing, or at what no policy is shown.

use crate::record::Model;
use wire::Position;
use wire::sim::ResetResponse;

/// A policy of the evaluator's own; no planner is asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Control {
    /// Rest: every action is zero.
    NoOp,
    /// Straight line to the position of the hand in the goal image, which is read from the simulator; the gripper's action is
    /// zero. Its success rate is that of copying the arm's final position alone.
    Oracle,
}

/// Share of the way to the target that the oracle's hand is displaced by at each step, up to the largest action.
const GAIN: f64 = 0.4;

impl Control {
    const ALL: [Self; 2] = [Self::NoOp, Self::Oracle];

    /// Name in `--models` and in records, and its method.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::NoOp => "no-op",
            Self::Oracle => "oracle",
        }
    }

    /// The control of a name.
    pub(crate) fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|control| control.name() == name)
    }

    /// The control that a model of a run is, if it is one.
    pub(crate) fn of(model: &Model) -> Option<Self> {
        Self::named(&model.method)
    }

    /// The control as a model of a run, without a checkpoint.
    pub(crate) fn model(self) -> Model {
        Model {
            name: self.name().into(),
            method: self.name().into(),
            digest: String::new(),
            training_tasks: Vec::new(),
            horizon: 1,
        }
    }

    /// The next action, with the hand at `hand`.
    pub(crate) fn action(self, reset: &ResetResponse, hand: Position) -> Vec<f32> {
        let mut action = vec![0.0; reset.control.action_size as usize];
        if self == Self::Oracle {
            let (hand, goal) = (hand.metres(), reset.goal_hand_position.metres());
            for (value, (hand, goal)) in action.iter_mut().zip(hand.into_iter().zip(goal)) {
                let way = f64::from(goal - hand) / reset.control.metres;
                *value = (GAIN * way).clamp(-1.0, 1.0) as f32;
            }
        }
        action
    }
}
