//! A recorded episode, played back through a planner: the same requests must get the same answers, bit for bit.

use crate::cli::ReplayArgs;
use crate::{link, presence, record};
use anyhow::{Context, ensure};
use recording::trial::Exchange;
use service_kit::network;
use std::fmt;
use std::time::Duration;
use tokio::time::Instant;
use wire::planner::{Goal, PlanRequest, PlanResponse, Search};
use wire::{Observation, key};

/// Timeout of the wait for the planner.
const WAIT: Duration = Duration::from_secs(10);
/// Maximum outage of a router or the planner.
const RECOVERY: Duration = Duration::from_secs(30);
/// Longer than any plan takes, on a slow machine too.
const PATIENCE: Duration = Duration::from_secs(600);

/// Result of the replay of a recorded episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Replay {
    /// Number of recorded plans.
    pub plans: usize,
    /// The first difference, with which a replay ends; none if every plan came again.
    pub difference: Option<Difference>,
}

/// A value that is not what was recorded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The step of the plan, from 0.
    pub step: usize,
    /// Which value, for example `actions[1][0]`.
    pub value: String,
    /// Recorded value.
    pub recorded: String,
    /// Value of the planner's answer now.
    pub now: String,
}

impl fmt::Display for Replay {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.difference {
            None => write!(f, "{} plans: bit for bit the same", self.plans),
            Some(Difference { step, value, recorded, now }) => {
                write!(f, "step {step} of {}: {value}: recorded {recorded}, now {now}", self.plans)
            }
        }
    }
}

/// Asks a planner again for every plan of a recorded episode, from the same checkpoint, and compares the answers.
///
/// # Errors
/// If the file is not the recording of a trial, or of one without plans; if the planner does not come up, or it refuses a request, as it does
/// without the checkpoint.
pub async fn replay(args: &ReplayArgs) -> anyhow::Result<Replay> {
    let recorded = record::read_recording(&args.file)?;
    let (trial, exchanges) = (recorded.trial(), recorded.exchanges());
    ensure!(!exchanges.is_empty(), "{}: expected plans, got a trial of {}", args.file.display(), trial.model);
    let start = Instant::now();
    let session = link::join(&args.session, WAIT).await?;
    let planners = [args.planner.clone()];
    let mut alive = presence::follow(&session, &planners).await?;
    presence::wait(&session, &mut alive, &planners, 0, start, WAIT).await?;

    let key = key::planner_plan(&args.planner)?;
    let mut difference = None;
    for (step, exchange) in exchanges.iter().enumerate() {
        let request = again(&trial.planned_goal(), exchange);
        let now = network::ask(&session, &key, request, PATIENCE, link::retry(RECOVERY));
        let now = now.await.with_context(|| format!("step {step}"))?;
        difference = compare(step, exchange, now);
        if difference.is_some() {
            break;
        }
    }
    if let Err(error) = session.close().await {
        tracing::warn!("closing the zenoh session: {error}");
    }
    Ok(Replay { plans: exchanges.len(), difference })
}

/// The request that brings a plan again, whatever the planner remembers and however long it takes.
fn again(goal: &Observation, Exchange { request, response, .. }: &Exchange) -> PlanRequest {
    let mut request = request.clone();
    request.goal = match goal {
        Observation::Image(image) => Goal::Image(image.clone()),
        Observation::Position(position) => Goal::Position(*position),
    };
    request.deadline = None;
    request.model_digest = Some(response.model_digest.clone());
    if let Some(search) = request.search.as_mut().filter(|search| search.anytime) {
        *search = Search { iterations: Some(response.iterations), anytime: false, ..*search };
    }
    request
}

/// The first value of a plan that is not as recorded.
fn compare(step: usize, Exchange { request, response, .. }: &Exchange, mut now: PlanResponse) -> Option<Difference> {
    let mut recorded = response.clone();
    if request.search.is_some_and(|search| search.anytime) {
        // The recorded losses are of the best plan so far, and go on with iterations that found nothing better.
        recorded.inner_losses.truncate(recorded.iterations as usize + 1);
        let mut best = f32::INFINITY;
        for loss in &mut now.inner_losses {
            best = if *loss < best { *loss } else { best };
            *loss = best;
        }
    }
    let difference = |value, recorded, now| Some(Difference { step, value, recorded, now });
    let (before, after) = (values(&recorded), values(&now));
    let longer = if before.len() > after.len() { &before } else { &after };
    for (index, (name, _)) in longer.iter().enumerate() {
        let of = |values: &[(String, &[f32])]| values.get(index).map_or(Vec::new(), |(_, values)| values.to_vec());
        let (before, after) = (of(&before), of(&after));
        if before.len() != after.len() {
            let count = |values: Vec<f32>| format!("{} values", values.len());
            return difference(name.clone(), count(before), count(after));
        }
        if let Some(at) = before.iter().zip(&after).position(|(before, after)| before.to_bits() != after.to_bits()) {
            return difference(format!("{name}[{at}]"), before[at].to_string(), after[at].to_string());
        }
    }
    if recorded.iterations != now.iterations {
        return difference("iterations".into(), recorded.iterations.to_string(), now.iterations.to_string());
    }
    if recorded.approach != now.approach {
        return difference("approach".into(), format!("{:?}", recorded.approach), format!("{:?}", now.approach));
    }
    None
}

/// Values that must be equal. The actions come last, so that the places of the others do not depend on their number.
fn values(plan: &PlanResponse) -> Vec<(String, &[f32])> {
    let mut values = vec![
        ("first_action".to_owned(), &plan.first_action[..]),
        ("inner_losses".to_owned(), &plan.inner_losses),
        ("latent_distance".to_owned(), plan.latent_distance.as_slice()),
    ];
    values.extend(plan.actions.iter().enumerate().map(|(index, action)| (format!("actions[{index}]"), &action[..])));
    values
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;
    use wire::Position;
    use wire::planner::{Approach, Solver, StageTimes};

    fn exchange(search: Option<Search>) -> Exchange {
        let position = Position::new([0.0; 3]).unwrap();
        let request = PlanRequest {
            model: "cpn".into(),
            goal: Goal::Position(position),
            observation: position.into(),
            seed: 7,
            deadline: Some(Duration::from_millis(5)),
            model_digest: None,
            search,
            warm_start: vec![vec![0.5; 3]; 2],
            steps_left: Some(9),
            approach: None,
        };
        let response = PlanResponse {
            actions: vec![vec![0.5, -2.0, 0.0]; 2],
            first_action: vec![0.5, -1.0, 0.0],
            inner_losses: vec![3.0, 3.0, 1.0, 1.0, 1.0],
            latent_distance: Some(4.0),
            times: StageTimes::default(),
            model_digest: "0".repeat(64),
            goal_id: Observation::from(position).digest(),
            iterations: 2,
            iterations_run: 4,
            warm_start: vec![vec![0.5; 3]; 2],
            approach: None,
        };
        Exchange { step: 0, request, asked: Duration::ZERO, response, answered: Duration::ZERO }
    }

    #[test]
    fn a_search_until_the_deadline_is_repeated_by_its_iterations() {
        let anytime = Search { solver: Solver::Gradient, iterations: None, samples: None, anytime: true };
        let goal = Position::new([0.0; 3]).unwrap().into();
        let recorded = exchange(Some(anytime));
        let request = again(&goal, &recorded);
        assert_eq!(request.search, Some(Search { iterations: Some(2), anytime: false, ..anytime }));
        assert_eq!((request.deadline, request.model_digest), (None, Some("0".repeat(64))));
        assert_eq!((request.seed, request.warm_start, request.steps_left), (7, vec![vec![0.5; 3]; 2], Some(9)));
        // A fixed number of updates answers the last plan, and tells the losses of all.
        let now = |losses: [f32; 3]| PlanResponse { inner_losses: losses.into(), ..recorded.response.clone() };
        assert_eq!(compare(0, &recorded, now([3.0, 5.0, 1.0])), None);
        assert_eq!(compare(0, &recorded, now([3.0, 5.0, 2.0])).unwrap().value, "inner_losses[2]");

        let fixed = exchange(Some(Search { iterations: Some(4), anytime: false, ..anytime }));
        assert_eq!(again(&goal, &fixed).search, fixed.request.search);
        assert_eq!(compare(0, &fixed, now([3.0, 3.0, 1.0])).unwrap().value, "inner_losses");
    }

    #[test]
    fn each_value_is_compared_by_its_bits() {
        type Spoil = fn(&mut PlanResponse);
        let recorded = exchange(None);
        let difference = |spoil: Spoil| {
            let mut now = recorded.response.clone();
            spoil(&mut now);
            compare(3, &recorded, now).map(|found| Replay { plans: 9, difference: Some(found) }.to_string())
        };
        let cases: [(Spoil, &str); 10] = [
            (|now| now.actions[1][2] = -0.0, "actions[1][2]: recorded 0, now -0"),
            (|now| now.actions[1][0] = 0.5f32.next_up(), "actions[1][0]: recorded 0.5, now 0.50000006"),
            (|now| drop(now.actions.pop()), "actions[1]: recorded 3 values, now 0 values"),
            (|now| now.actions.push(vec![0.0]), "actions[2]: recorded 0 values, now 1 values"),
            (|now| now.first_action[1] = 1.0, "first_action[1]: recorded -1, now 1"),
            (|now| now.inner_losses[0] = 9.0, "inner_losses[0]: recorded 3, now 9"),
            (|now| now.latent_distance = None, "latent_distance: recorded 1 values, now 0 values"),
            (|now| now.latent_distance = Some(4.5), "latent_distance[0]: recorded 4, now 4.5"),
            (|now| now.iterations = 3, "iterations: recorded 2, now 3"),
            (
                |now| now.approach = Some(Approach { tried: 1, position: [0.0; 3], plans: 2 }),
                "approach: recorded None, now Some(Approach { tried: 1, position: [0.0, 0.0, 0.0], plans: 2 })",
            ),
        ];
        for (spoil, expected) in cases {
            assert_eq!(difference(spoil).unwrap(), format!("step 3 of 9: {expected}"));
        }
        assert_eq!(difference(|now| now.times.plan_seconds = 1.0), None);
    }
}
