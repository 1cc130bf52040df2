//! Approach of an episode: progress of the hand through targets, the next one where it stalls.

/// Distance beyond which the hand has moved, in standard deviations.
const MOTION: f32 = 0.1;
/// Distance within which the hand is at the goal's position, in standard deviations.
const GOAL_RADIUS: f32 = 0.15;
/// Distance within which the hand has passed a target beside the goal, in standard deviations.
const PASSING_RADIUS: f32 = 0.7;
/// Distance between the goal's position and a target beside it, in standard deviations.
const OFFSET: f32 = 2.0;
/// Height above a target beside the goal of the target before it, over what stands between, in standard deviations.
const RISE: f32 = 1.0;
/// Number of plans without motion after which the hand has stalled.
const PATIENCE: u32 = 8;
/// The same under the policy's plans, which rest to grasp.
const POLICY_PATIENCE: u32 = 24;
/// Largest absolute value of a position that is kept, in standard deviations.
const MAX_POSITION: f32 = 1000.0;
/// Sides of the goal to come from, in turn, x towards the middle of the training positions: inside, outside, below, above, front and
/// back in Meta-World.
const SIDES: [[f32; 3]; 6] =
    [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]];
/// Number of targets of a side: above it, beside the goal, and the goal again.
const TARGETS: u32 = 3;

/// Progress of an episode's hand through its targets, of a model with position dynamics. The targets are, for a familiar goal, first the
/// ends of the policy's plans; then the goal's position, and for each side of it in turn one above, one beside and the goal's again. The
/// next target begins when the hand is at the last or has stalled: the progress check of navigation (Nav2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Approach {
    /// Number of targets that were reached or given up.
    pub tried: u32,
    /// Position of the hand when it last moved, standardised: elements of an embedding.
    pub position: [f32; 3],
    /// Number of plans since then.
    pub plans: u32,
}

/// Target of the hand.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Target {
    /// Ends of the policy's plans.
    Policy,
    /// The goal's position.
    Goal,
    /// The goal's position, moved by so many standard deviations, x towards the middle of the training positions.
    Beside([f32; 3]),
}

impl Approach {
    /// Approach at the first plan of an episode, whose observation has the embedding `x`, `[Z]`.
    pub fn first(x: &[f32]) -> Self {
        Self { tried: 0, position: position(x), plans: 0 }
    }

    /// Approach at the next plan, from the embeddings of its observation and goal, `[Z]` each.
    pub fn next(self, x: &[f32], x_g: &[f32], is_familiar: bool) -> Self {
        let hand = position(x);
        let target = self.target(is_familiar);
        let patience = if target == Target::Policy { POLICY_PATIENCE } else { PATIENCE };
        let radius = if target == Target::Goal { GOAL_RADIUS } else { PASSING_RADIUS };
        let has_arrived = target.position(x_g).is_some_and(|target| distance(hand, target) <= radius);
        let has_moved = distance(hand, self.position) > MOTION;
        let plans = self.plans.saturating_add(1);

        if has_arrived || (!has_moved && plans >= patience) {
            Self { tried: self.tried.saturating_add(1), position: hand, plans: 0 }
        } else if has_moved {
            Self { position: hand, plans: 0, ..self }
        } else {
            Self { plans, ..self }
        }
    }

    /// True if the policy's plan is kept without updates.
    pub fn keeps_policy(&self, is_familiar: bool) -> bool {
        self.target(is_familiar) == Target::Policy
    }

    /// Embedding to plan towards, `[Z]`: the goal's, with the position of the target.
    pub fn towards(&self, x_g: &[f32], is_familiar: bool) -> Vec<f32> {
        let mut towards = x_g.to_vec();
        if let Some(position) = self.target(is_familiar).position(x_g) {
            towards[..3].copy_from_slice(&position);
        }
        towards
    }

    fn target(&self, is_familiar: bool) -> Target {
        let tried = match (is_familiar, self.tried) {
            (true, 0) => return Target::Policy,
            (true, tried) => tried - 1,
            (false, tried) => tried,
        };
        let side = SIDES[(tried / TARGETS) as usize % SIDES.len()].map(|direction| OFFSET * direction);
        match tried % TARGETS {
            0 => Target::Goal,
            1 => Target::Beside([side[0], side[1], side[2] + RISE]),
            _ => Target::Beside(side),
        }
    }
}

impl Target {
    /// Position of the target, standardised; none of the policy's.
    fn position(self, x_g: &[f32]) -> Option<[f32; 3]> {
        let goal = position(x_g);
        match self {
            Self::Policy => None,
            Self::Goal => Some(goal),
            Self::Beside([x, y, z]) => Some([goal[0] - goal[0].signum() * x, goal[1] + y, goal[2] + z]),
        }
    }
}

/// Position in an embedding, within the bounds of [`Approach::position`].
fn position(x: &[f32]) -> [f32; 3] {
    [x[0], x[1], x[2]].map(|value| value.clamp(-MAX_POSITION, MAX_POSITION))
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOAL: [f32; 4] = [1.0, 2.0, 3.0, 7.0];

    /// The approach after so many plans with the hand at a position.
    fn rest(approach: Approach, x: [f32; 4], is_familiar: bool, plans: u32) -> Approach {
        (0..plans).fold(approach, |approach, _| approach.next(&x, &GOAL, is_familiar))
    }

    #[test]
    fn a_stalled_hand_tries_the_sides_of_the_goal_in_turn() {
        let far = [0.0; 4];
        let mut approach = Approach::first(&far);
        let mut targets = Vec::new();
        for _ in 0..6 {
            targets.push(approach.towards(&GOAL, false));
            assert_eq!(rest(approach, far, false, PATIENCE - 1).tried, approach.tried);
            approach = rest(approach, far, false, PATIENCE);
        }
        let inside = [[-1.0, 2.0, 4.0, 7.0], [-1.0, 2.0, 3.0, 7.0]];
        let outside = [[3.0, 2.0, 4.0, 7.0], [3.0, 2.0, 3.0, 7.0]];
        assert_eq!(targets, [GOAL, inside[0], inside[1], GOAL, outside[0], outside[1]]);
        let mirrored = Approach { tried: 2, ..approach }.towards(&[-1.0, 2.0, 3.0, 7.0], false);
        assert_eq!(mirrored, [1.0, 2.0, 3.0, 7.0]);
        let round = TARGETS * SIDES.len() as u32;
        let again = Approach { tried: round + 1, ..approach };
        assert_eq!(again.towards(&GOAL, false), targets[1]);
        assert_eq!(rest(Approach { tried: u32::MAX, ..approach }, far, true, PATIENCE).tried, u32::MAX);
        assert_eq!(Approach { plans: u32::MAX, ..Approach::first(&far) }.next(&far, &GOAL, false).tried, 1);
        assert_eq!(Approach::first(&[-2000.0, 0.0, 2000.0]).position, [-1000.0, 0.0, 1000.0]);
    }

    #[test]
    fn a_hand_that_moves_or_arrives_does_not_stall() {
        let mut approach = Approach::first(&[0.0; 4]);
        for step in 1..50 {
            approach = approach.next(&[0.0, 0.0, 0.03 * step as f32, 0.0], &[9.0; 4], false);
        }
        assert_eq!(approach.tried, 0);
        let (far, near) = ([1.0, 2.0, 2.8, 0.0], [1.0, 2.0, 2.87, 0.0]);
        assert_eq!(approach.next(&far, &GOAL, false).tried, 0);
        let raised = approach.next(&near, &GOAL, false);
        assert_eq!(raised, Approach { tried: 1, position: [1.0, 2.0, 2.87], plans: 0 });
        assert_eq!(raised.next(&[-1.0, 2.0, 3.2, 0.0], &GOAL, false).tried, 1);
        assert_eq!(raised.next(&[-1.0, 2.0, 3.4, 0.0], &GOAL, false).tried, 2, "it passes a target beside the goal");
    }

    #[test]
    fn a_familiar_goal_gets_the_policy_first_for_longer() {
        let x = GOAL;
        let first = Approach::first(&x);
        let later = rest(first, x, true, POLICY_PATIENCE - 1);
        assert!(first.keeps_policy(true) && later.keeps_policy(true));
        let given_up = rest(later, x, true, 1);
        assert_eq!((given_up.keeps_policy(true), given_up.towards(&[0.0; 4], true)), (false, vec![0.0; 4]));
        assert!(!first.keeps_policy(false));
    }
}
