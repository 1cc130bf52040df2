//! One first attempt: closes the loop between a simulator worker and the planner.

use crate::link::{Link, is_outage};
use crate::presence::Service;
use crate::record::{self, GoalSource, Model, Outcome, Run, StageTimes};
use anyhow::bail;
use recording::plans::{Exchange, Plans};
use std::time::Instant;
use wire::planner::{Goal, PlanRequest, PlanResponse, RegisterGoalRequest, RegisterGoalResponse};
use wire::replay::PlannedEpisode;
use wire::sim::{ResetRequest, ResetResponse, StepRequest, StepResponse, Variation};
use wire::{Code, Error, Image, Observation, key};

/// Variations that are tried for the goal of an ablation.
const GOAL_TRIES: u32 = 10;

/// The services that a trial is run with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Services {
    /// Name of the planner.
    pub(crate) planner: String,
    /// Name of the worker.
    pub(crate) worker: String,
}

/// An attempt that came to its end.
#[derive(Debug)]
pub(crate) struct Attempt {
    pub(crate) outcome: Outcome,
    pub(crate) episode: record::Episode,
    /// What the finished task looks like.
    pub(crate) goal: Image,
    /// Every frame from the first on, one more than steps.
    pub(crate) frames: Vec<Image>,
    /// What the planner was asked, and its answers.
    pub(crate) plans: Plans,
}

/// Why an attempt came to no end.
#[derive(Debug)]
pub(crate) enum Fault {
    /// The expert does not solve the variation, hence there is no goal image: nobody can be evaluated on it.
    NoGoalImage,
    /// A request that is wrong and will stay wrong.
    Refused(Error),
    /// A router or a service was away for too long, or is another one since. A trial that begins anew will fare better.
    Outage {
        /// The service that did not answer, or not as before.
        by: Service,
        /// The error.
        error: Error,
    },
    /// A fault of a service. Another attempt may fare better.
    Broken {
        /// The service.
        by: Service,
        /// The error.
        error: Error,
    },
}

impl Fault {
    fn new(by: Service, error: Error) -> Self {
        match (error.code, error.field.as_str()) {
            (Code::FailedPrecondition, "variation.seed" | "goal_seed") => Self::NoGoalImage,
            // A worker without the task's simulator; pictures of two renderings.
            (Code::FailedPrecondition, "variation.task" | "goal_id" | "observation.render_spec")
            | (Code::InvalidArgument, _) => Self::Refused(error),
            _ if is_outage(&error) => Self::Outage { by, error },
            // A worker or a planner that was started anew: without the episode, or with other checkpoints.
            (Code::NotFound, "episode_id" | "goal_id" | "model") | (Code::FailedPrecondition, "model_digest") => {
                Self::Outage { by, error }
            }
            _ => Self::Broken { by, error },
        }
    }
}

/// Checks that a worker knows a task, and that every model takes what its goal is; seeds that the expert does not solve are
/// passed over.
///
/// # Errors
/// Why a request was refused as wrong.
pub(crate) async fn check(
    link: &Link,
    services: &Services,
    run: &Run,
    Variation { task, seed }: &Variation,
) -> anyhow::Result<()> {
    for seed in *seed..seed.saturating_add(GOAL_TRIES.into()) {
        let variation = Variation { task: task.clone(), seed };
        match check_variation(link, services, run, &variation).await {
            Err((_, Fault::NoGoalImage)) => (),
            Err((by, Fault::Refused(error))) => bail!("{task} {seed}, {by}: refused: {error}"),
            Err((by, Fault::Outage { error, .. } | Fault::Broken { error, .. })) => {
                tracing::debug!("{task} {seed}, {by}: not checked: {error}");
                return Ok(());
            }
            Ok(()) => return Ok(()),
        }
    }
    Ok(())
}

/// The same of one variation; a fault comes with who found it.
async fn check_variation(
    link: &Link,
    Services { planner, worker }: &Services,
    run: &Run,
    variation: &Variation,
) -> Result<(), (String, Fault)> {
    let (planner, worker) = (Service::Planner(planner.clone()), Service::Worker(worker.clone()));
    let by_worker = |error| (worker.to_string(), Fault::new(worker.clone(), error));
    let reset = link.reset(&worker, variation, run.goal).await.map_err(by_worker)?;
    for model in &run.models {
        let by_planner = |error| (model.name.clone(), Fault::new(planner.clone(), error));
        let goal = link.goal(&planner, &reset).await.map_err(by_planner)?;
        let observation = reset.hand_position.map_or_else(|| reset.observation.clone().into(), Observation::from);
        let request = link.plan_request(model, goal, observation, plan_seed(variation.seed, 0));
        link.plan(&planner, request).await.map_err(by_planner)?;
    }
    Ok(())
}

/// Runs one episode: plans anew at each step and applies the first action (model predictive control). Where the goal is a
/// position, the model is told that and where the hand is, and no picture.
pub(crate) async fn attempt(
    link: &Link,
    Services { planner, worker }: &Services,
    model: &Model,
    variation: &Variation,
    goal: GoalSource,
) -> Result<Attempt, Fault> {
    let (planner, worker) = (Service::Planner(planner.clone()), Service::Worker(worker.clone()));
    let by_planner = |error| Fault::new(planner.clone(), error);
    let by_worker = |error| Fault::new(worker.clone(), error);
    let reset = link.reset(&worker, variation, goal).await.map_err(by_worker)?;
    let start = Instant::now();
    let goal = link.goal(&planner, &reset).await.map_err(by_planner)?;
    let step_key = key::sim_step(worker.name()).map_err(by_worker)?;
    let mut exchanges = Vec::new();
    let mut hand = reset.hand_position;
    let mut frames = vec![reset.observation];
    for step in 0..reset.max_steps {
        let observation = hand.map_or_else(|| frames[frames.len() - 1].clone().into(), Observation::from);
        let request = link.plan_request(model, goal.clone(), observation, plan_seed(variation.seed, step));
        let asked = start.elapsed();
        let mut plan = link.plan(&planner, request.clone()).await;
        if plan.as_ref().is_err_and(|e| e.code == Code::NotFound && e.field == "goal_id") {
            // The planner was restarted, or has evicted the goal.
            link.register_goal(&planner, &reset.goal).await.map_err(by_planner)?;
            plan = link.plan(&planner, request.clone()).await;
        }
        let response = plan.map_err(by_planner)?;
        let action = response.first_action.clone();
        exchanges.push(Exchange { request, asked, response, answered: start.elapsed() });
        let request = StepRequest { episode_id: reset.episode_id.clone(), step, action };
        let response: StepResponse = link.call(&worker, step_key.clone(), request).await.map_err(by_worker)?;
        hand = response.hand_position;
        frames.push(response.observation);
        if response.done {
            let outcome = if response.success { Outcome::Success } else { Outcome::Failure };
            let episode = PlannedEpisode {
                variation: variation.clone(),
                model: model.name.clone(),
                model_digest: model.digest.clone(),
                goal: reset.goal_position.map_or_else(|| reset.goal.clone().into(), Observation::from),
                plans: step + 1,
            };
            let plans = Plans::new(episode, exchanges).map_err(by_planner)?;
            return Ok(Attempt { outcome, episode: course(&plans), goal: reset.goal, frames, plans });
        }
    }
    let expected = format!("true after {} steps", reset.max_steps);
    Err(by_worker(Error::new(Code::Internal, "done", expected, false)))
}

/// Seed of the plan before a step: no two steps of an evaluation share one.
fn plan_seed(variation: u64, step: u32) -> u64 {
    (variation << 16) + u64::from(step)
}

impl Link {
    async fn reset(&self, worker: &Service, variation: &Variation, goal: GoalSource) -> Result<ResetResponse, Error> {
        let mut goal_seed = match goal {
            GoalSource::SameVariation => None,
            GoalSource::OtherVariation => Some(variation.seed + 1),
        };
        let mut left = GOAL_TRIES;
        loop {
            left -= 1;
            let request = ResetRequest { variation: variation.clone(), goal_seed };
            match self.call(worker, key::sim_reset(worker.name())?, request).await {
                // The expert does not solve the other variation: the next one will do as well.
                Err(error) if error.field == "goal_seed" && left > 0 => goal_seed = goal_seed.map(|seed| seed + 1),
                answer => return answer,
            }
        }
    }

    /// The goal of an episode as the planner is told it: a position, or the id of a picture that it gets to know.
    async fn goal(&self, planner: &Service, reset: &ResetResponse) -> Result<Goal, Error> {
        Ok(match reset.goal_position {
            Some(position) => Goal::Position(position),
            None => Goal::Id(self.register_goal(planner, &reset.goal).await?),
        })
    }

    fn plan_request(&self, model: &Model, goal: Goal, observation: Observation, seed: u64) -> PlanRequest {
        PlanRequest {
            seed,
            deadline: Some(self.timeout),
            // The one that the run began with, though the planner may swap.
            model_digest: Some(model.digest.clone()),
            ..PlanRequest::new(&model.name, goal, observation)
        }
    }

    async fn plan(&self, planner: &Service, request: PlanRequest) -> Result<PlanResponse, Error> {
        self.call(planner, key::planner_plan(planner.name())?, request).await
    }

    async fn register_goal(&self, planner: &Service, goal: &Image) -> Result<String, Error> {
        let request = RegisterGoalRequest { image: goal.clone() };
        let key = key::planner_register_goal(planner.name())?;
        let response: RegisterGoalResponse = self.call(planner, key, request).await?;
        Ok(response.goal_id)
    }
}

/// What the plans of an episode tell about themselves.
fn course(plans: &Plans) -> record::Episode {
    let plans: Vec<_> = plans.exchanges().iter().map(|exchange| &exchange.response).collect();
    let finite = |value: f32| value.is_finite().then_some(value);
    let inner_losses = |plan: Option<&&PlanResponse>| {
        plan.iter().flat_map(|plan| &plan.inner_losses).map(|&loss| finite(loss)).collect()
    };
    let mean =
        |seconds: fn(&PlanResponse) -> f64| plans.iter().map(|plan| seconds(plan)).sum::<f64>() / plans.len() as f64;
    record::Episode {
        goal_id: plans.last().map(|plan| plan.goal_id.clone()).unwrap_or_default(),
        steps: plans.len() as u32,
        latent_distances: plans.iter().filter_map(|plan| plan.latent_distance).map(finite).collect(),
        first_inner_losses: inner_losses(plans.first()),
        last_inner_losses: inner_losses(plans.last()),
        mean_times: StageTimes {
            queue_seconds: mean(|plan| plan.times.queue_seconds),
            encode_seconds: mean(|plan| plan.times.encode_seconds),
            plan_seconds: mean(|plan| plan.times.plan_seconds),
        },
    }
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;
    use crate::presence::Alive;
    use service_kit::SessionConfig;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;
    use tokio::sync::watch;
    use wire::query;
    use zenoh::Session;
    use zenoh::key_expr::OwnedKeyExpr;
    use zenoh::query::Query;

    const DIGEST: &str = "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff";

    fn image(shade: u8) -> Image {
        Image::new(2, 2, vec![shade; 12]).unwrap()
    }

    async fn serve(session: &Session, key: OwnedKeyExpr, answer: impl Fn(&Query) + Send + Sync + 'static) {
        session.declare_queryable(key).complete(true).callback(move |query| answer(&query)).background().await.unwrap();
    }

    /// A worker whose episodes are solved by the third step, and a planner that forgets each goal once.
    async fn forgetful() -> (Link, Arc<AtomicUsize>) {
        let session = service_kit::session::open(&SessionConfig::default()).await.unwrap();
        serve(&session, key::sim_reset("w").unwrap(), |query| {
            let ResetRequest { variation, goal_seed } = query::request::<ResetRequest>(query).unwrap();
            let result = match goal_seed.unwrap_or(variation.seed) {
                13 => Err(Error::new(Code::FailedPrecondition, "goal_seed", "another", 13)),
                100.. => Err(Error::new(Code::FailedPrecondition, "goal_seed", "another", 100)),
                _ if variation.task == "unknown" => Err(Error::invalid("variation.task", "a task", "unknown")),
                _ => Ok(ResetResponse {
                    episode_id: "e".into(),
                    goal: image(255),
                    observation: image(0),
                    max_steps: 5,
                    goal_position: None,
                    hand_position: None,
                }),
            };
            query::reply(query, result).unwrap();
        })
        .await;
        serve(&session, key::sim_step("w").unwrap(), |query| {
            let step = query::request::<StepRequest>(query).unwrap().step;
            let solved = step == 2;
            let observation = image(step as u8 + 1);
            let (reward, success, done, hand_position) = (0.0, solved, solved, None);
            query::reply(query, Ok(StepResponse { observation, reward, success, done, hand_position })).unwrap();
        })
        .await;
        let registered = Arc::new(AtomicUsize::new(0));
        let count = registered.clone();
        serve(&session, key::planner_register_goal("p").unwrap(), move |query| {
            count.fetch_add(1, Ordering::SeqCst);
            let goal_id = query::request::<RegisterGoalRequest>(query).unwrap().image.digest();
            query::reply(query, Ok(RegisterGoalResponse { goal_id })).unwrap();
        })
        .await;
        let count = registered.clone();
        serve(&session, key::planner_plan("p").unwrap(), move |query| {
            let request = query::request::<PlanRequest>(query).unwrap();
            let result = if request.model_digest.as_deref() != Some(DIGEST) {
                Err(Error::new(Code::FailedPrecondition, "model_digest", DIGEST, "another"))
            } else if count.load(Ordering::SeqCst) < 2 {
                Err(Error::new(Code::NotFound, "goal_id", "a goal", "forgotten"))
            } else {
                Ok(PlanResponse {
                    actions: vec![vec![0.0; 4]],
                    first_action: vec![0.0; 4],
                    inner_losses: vec![f32::NAN, request.seed as f32],
                    latent_distance: Some(1.0),
                    times: wire::planner::StageTimes { plan_seconds: 0.5, ..Default::default() },
                    model_digest: DIGEST.into(),
                    goal_id: image(255).digest(),
                    iterations: 0,
                    iterations_run: 0,
                    warm_start: Vec::new(),
                })
            };
            query::reply(query, result).unwrap();
        })
        .await;
        let (timeout, recovery) = (Duration::from_secs(10), Duration::ZERO);
        (Link { session, timeout, recovery, alive: watch::channel(Alive::default()).1 }, registered)
    }

    fn model(digest: &str) -> Model {
        let (name, method, digest) = ("cpn".into(), "cpn".into(), digest.into());
        Model { name, method, digest, training_tasks: Vec::new(), horizon: 1 }
    }

    fn with(worker: &str) -> Services {
        Services { planner: "p".into(), worker: worker.into() }
    }

    fn variation(task: &str, seed: u64) -> Variation {
        Variation { task: task.into(), seed }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_forgotten_goal_is_registered_again_and_the_episode_recorded() {
        let (link, registered) = forgetful().await;
        let goal = GoalSource::SameVariation;
        let attempt = attempt(&link, &with("w"), &model(DIGEST), &variation("reach", 1), goal).await.unwrap();
        assert_eq!(registered.load(Ordering::SeqCst), 2);
        assert_eq!((attempt.outcome, attempt.frames.len()), (Outcome::Success, 4));
        let plans = attempt.plans;
        assert_eq!((plans.exchanges().len(), &plans.episode().goal), (3, &image(255).into()));
        let episode = attempt.episode;
        assert_eq!((episode.steps, episode.latent_distances), (3, vec![Some(1.0); 3]));
        let seeds = [1 << 16, (1 << 16) + 2].map(|seed| seed as f32);
        assert_eq!(episode.first_inner_losses, [None, Some(seeds[0])]);
        assert_eq!(episode.last_inner_losses, [None, Some(seeds[1])]);
        assert_eq!(episode.mean_times.plan_seconds, 0.5);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn faults_are_told_apart() {
        let (link, _) = forgetful().await;
        let fault = async |worker: &str, digest: &str, variation: Variation| {
            attempt(&link, &with(worker), &model(digest), &variation, GoalSource::SameVariation).await.unwrap_err()
        };
        // The expert solves none of the variations whose goal could be shown.
        let goal = GoalSource::OtherVariation;
        let other = attempt(&link, &with("w"), &model(DIGEST), &variation("reach", 99), goal).await;
        assert!(matches!(other, Err(Fault::NoGoalImage)));
        // It solves seed 12, not 13, and the one after, whose goal is shown instead.
        attempt(&link, &with("w"), &model(DIGEST), &variation("reach", 12), goal).await.unwrap();
        assert!(matches!(fault("w", DIGEST, variation("reach", 13)).await, Fault::NoGoalImage));
        assert!(
            matches!(fault("w", DIGEST, variation("unknown", 1)).await, Fault::Refused(e) if e.field == "variation.task")
        );
        let nobody = fault("nobody", DIGEST, variation("reach", 1)).await;
        assert!(
            matches!(nobody, Fault::Outage { by: Service::Worker(name), error } if name == "nobody" && error.code == Code::Unavailable)
        );
        // The planner does not keep the checkpoint any more.
        let other = fault("w", &"0".repeat(64), variation("reach", 1)).await;
        assert!(
            matches!(other, Fault::Outage { by: Service::Planner(name), error } if name == "p" && error.field == "model_digest")
        );
        // The worker was started anew; it has a fault of its own.
        let of_worker = |code, field: &str| Fault::new(Service::Worker("w".into()), Error::new(code, field, "", ""));
        assert!(matches!(of_worker(Code::NotFound, "episode_id"), Fault::Outage { .. }));
        assert!(matches!(of_worker(Code::Internal, ""), Fault::Broken { .. }));
    }
}
