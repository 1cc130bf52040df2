//! One first attempt: closes the loop between a simulator worker and the planner.

use crate::actor::{self, Actor};
use crate::control::Control;
use crate::link::Link;
use crate::presence::Service;
use crate::record::{self, GoalSource, Model, Outcome, Run, StageTimes};
use crate::watchers::Watchers;
use anyhow::bail;
use recording::trial::{Exchange, Frame, Recording};
use service_kit::network::is_outage;
use std::time::{Duration, Instant};
use wire::planner::PlanResponse;
use wire::sim::{ResetRequest, ResetResponse, StepRequest, StepResponse, Variation};
use wire::trial::RecordedTrial;
use wire::{Code, Error, key};

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
    pub(crate) recording: Recording,
}

/// Why an attempt came to no end.
#[derive(Debug)]
pub(crate) enum Fault {
    /// The expert does not solve the variation, hence there is no goal image: nobody can be evaluated on it.
    NoGoalImage,
    /// The task is solved before any action: nothing is left to attempt.
    SolvedAtReset,
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
    pub(crate) fn new(by: Service, error: Error) -> Self {
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
            Err((_, Fault::NoGoalImage | Fault::SolvedAtReset)) => (),
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
    for model in run.models.iter().filter(|model| Control::of(model).is_none()) {
        let by_planner = |error| (model.name.clone(), Fault::new(planner.clone(), error));
        let goal = link.goal(&planner, &reset).await.map_err(by_planner)?;
        let observation = actor::observed(&reset, &reset.observation, reset.hand_position);
        let (seed, steps_left) = (actor::plan_seed(variation.seed, 0), run.planning.steps_left(reset.max_steps, 0));
        let request = link.plan_request(model, &run.planning, goal, observation, seed, steps_left);
        link.plan(&planner, request).await.map_err(by_planner)?;
    }
    Ok(())
}

/// Runs one episode: plans, applies the first actions of the plan and plans anew (model predictive control). Where the goal is a
/// position, the model is told that and where the hand is, and no picture.
pub(crate) async fn attempt(
    link: &Link,
    Services { planner, worker }: &Services,
    model: &Model,
    variation: &Variation,
    run: &Run,
) -> Result<Attempt, Fault> {
    let worker = Service::Worker(worker.clone());
    let by_worker = |error| Fault::new(worker.clone(), error);
    let reset = link.reset(&worker, variation, run.goal).await.map_err(by_worker)?;
    if reset.success {
        return Err(Fault::SolvedAtReset);
    }
    let planner = Service::Planner(planner.clone());
    let start = Instant::now();
    let mut actor = Actor::new(link, planner, model, &run.planning, variation.seed, &reset, start).await?;

    let step_key = key::sim_step(worker.name()).map_err(by_worker)?;
    let watchers = Watchers::new(link, worker.name(), &reset.episode_id, &model.name).await;
    let mut hand = reset.hand_position;
    let mut frames = vec![Frame { image: reset.observation.clone(), time: Duration::ZERO }];
    let mut progress = vec![reset.progress];
    let mut step = 0;
    let mut held = vec![0.0; reset.control.action_size as usize];
    while step < reset.max_steps {
        let mut decided = actor.decide(&reset, step, &frames[frames.len() - 1].image, hand).await?;
        if let Some((watchers, exchange)) = watchers.as_ref().zip(actor.latest()) {
            watchers.show(exchange).await;
        }
        if run.planning.real_time {
            let steps = (decided.thinking_seconds * reset.control.hz).ceil().max(1.0) as usize;
            let next = decided.actions.swap_remove(0);
            decided.actions = vec![std::mem::replace(&mut held, next); steps.min(reset.max_steps as usize)];
        }

        for action in decided.actions {
            let request = StepRequest { episode_id: reset.episode_id.clone(), step, action };
            let response: StepResponse = link.call(&worker, step_key.clone(), request).await.map_err(by_worker)?;
            step += 1;
            hand = response.hand_position;
            frames.push(Frame { image: response.observation, time: start.elapsed() });
            progress.push(response.progress);
            if response.done {
                let outcome = if response.success { Outcome::Success } else { Outcome::Failure };
                let exchanges = actor.exchanges();
                let trial = RecordedTrial {
                    variation: variation.clone(),
                    model: model.name.clone(),
                    model_digest: model.digest.clone(),
                    goal: reset.goal,
                    goal_position: reset.goal_position,
                    steps: step,
                    plans: exchanges.len() as u32,
                };
                let recording = Recording::new(trial, frames, exchanges).map_err(Fault::Refused)?;
                return Ok(Attempt { outcome, episode: course(&recording, progress), recording });
            }
        }
    }
    let expected = format!("true after {} steps", reset.max_steps);
    Err(by_worker(Error::new(Code::Internal, "done", expected, false)))
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
}

/// The course of an episode, with statistics of its plans if there are any.
fn course(recording: &Recording, progress: Vec<f64>) -> record::Episode {
    let (trial, exchanges) = (recording.trial(), recording.exchanges());
    let plans: Vec<_> = exchanges.iter().map(|exchange| &exchange.response).collect();
    let is_before_every_step = exchanges.iter().zip(0..).all(|(Exchange { step, .. }, plan)| *step == plan);
    let finite = |value: f32| value.is_finite().then_some(value);
    let inner_losses = |plan: Option<&&PlanResponse>| {
        plan.iter().flat_map(|plan| &plan.inner_losses).map(|&loss| finite(loss)).collect()
    };
    let mean = |seconds: fn(&PlanResponse) -> f64| {
        plans.iter().map(|plan| seconds(plan)).sum::<f64>() / plans.len().max(1) as f64
    };
    record::Episode {
        goal_id: trial.planned_goal().digest(),
        steps: trial.steps,
        progress,
        plan_steps: exchanges.iter().map(|exchange| exchange.step).filter(|_| !is_before_every_step).collect(),
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
    use crate::planning::Planning;
    use crate::presence::Alive;
    use service_kit::SessionConfig;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use tokio::sync::watch;
    use wire::planner::{Approach, PlanRequest, RegisterGoalRequest, RegisterGoalResponse};
    use wire::sim::TrialPlan;
    use wire::{Image, Position, query, sim};
    use zenoh::Session;
    use zenoh::key_expr::OwnedKeyExpr;
    use zenoh::query::Query;

    const DIGEST: &str = "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff";

    fn image(shade: u8) -> Image {
        Image::new(2, 2, vec![shade; 12]).unwrap()
    }

    fn at(x: f32) -> Position {
        Position::new([x, 0.0, 0.0]).unwrap()
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
                    hand_position: at(0.0),
                    goal_hand_position: at(0.1),
                    success: variation.seed == 50,
                    progress: 0.0,
                    control: sim::Control { action_size: 4, metres: 0.01, hz: 10.0 },
                }),
            };
            query::reply(query, result).unwrap();
        })
        .await;
        serve(&session, key::sim_step("w").unwrap(), |query| {
            let StepRequest { step, action, .. } = query::request(query).unwrap();
            let solved = step == 2;
            let response = StepResponse {
                observation: image(step as u8 + 1),
                reward: 0.0,
                success: solved,
                done: solved,
                hand_position: at(0.01 * (step + 1) as f32),
                // Tells which action came.
                progress: f64::from(action[0]),
            };
            query::reply(query, Ok(response)).unwrap();
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
                // Begins where it was told to, else at the seed; rises by a tenth at each action, beyond what can be applied.
                let first = request.warm_start.first().map_or((request.seed % 8) as f32 / 4.0, |start| start[0]);
                let actions: Vec<_> = (0..3u8).map(|k| vec![first + 0.1 * f32::from(k); 4]).collect();
                Ok(PlanResponse {
                    first_action: vec![first.min(1.0); 4],
                    warm_start: actions[1..].iter().chain(&actions[2..]).cloned().collect(),
                    actions,
                    inner_losses: vec![f32::NAN, request.seed as f32],
                    latent_distance: Some(1.0),
                    times: wire::planner::StageTimes { plan_seconds: 0.5, ..Default::default() },
                    model_digest: DIGEST.into(),
                    goal_id: image(255).digest(),
                    iterations: 0,
                    iterations_run: request.search.map_or(0, |search| search.iterations.unwrap_or_default()),
                    approach: request.search.is_none().then(|| Approach {
                        tried: 0,
                        position: [0.0; 3],
                        plans: request.approach.map_or(1, |approach| approach.plans + 1),
                    }),
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
        Model { name, method, digest, training_tasks: Vec::new(), horizon: 3 }
    }

    fn run(goal: GoalSource, planning: Planning) -> Run {
        Run {
            format: record::FORMAT,
            title: String::new(),
            command: String::new(),
            date: String::new(),
            planners: Vec::new(),
            models: Vec::new(),
            tasks: Vec::new(),
            trials: 1,
            first_seed: 0,
            goal,
            planning,
        }
    }

    fn default_run() -> Run {
        run(GoalSource::SameVariation, Planning::default())
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
        let attempt = attempt(&link, &with("w"), &model(DIGEST), &variation("reach", 1), &default_run()).await.unwrap();
        assert_eq!(registered.load(Ordering::SeqCst), 2);
        let recording = attempt.recording;
        assert_eq!((attempt.outcome, recording.frames().len()), (Outcome::Success, 4));
        assert_eq!((recording.exchanges().len(), &recording.trial().goal), (3, &image(255)));
        let episode = attempt.episode;
        assert_eq!((episode.steps, episode.latent_distances), (3, vec![Some(1.0); 3]));
        assert_eq!((episode.progress, episode.plan_steps), (vec![0.0, 0.0, 0.25, 0.5], vec![]));
        let seeds = [1 << 16, (1 << 16) + 2].map(|seed| seed as f32);
        assert_eq!(episode.first_inner_losses, [None, Some(seeds[0])]);
        assert_eq!(episode.last_inner_losses, [None, Some(seeds[1])]);
        assert_eq!(episode.mean_times.plan_seconds, 0.5);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn plans_are_published_for_watchers() {
        let (link, _) = forgetful().await;
        let watcher = link.session.declare_subscriber(key::sim_plan("*").unwrap()).await.unwrap();
        let attempt = attempt(&link, &with("w"), &model(DIGEST), &variation("reach", 1), &default_run()).await.unwrap();
        assert!(!attempt.recording.exchanges().is_empty());
        for Exchange { step, response, .. } in attempt.recording.exchanges() {
            let sample = watcher.try_recv().unwrap().unwrap();
            assert_eq!(sample.key_expr().as_str(), key::sim_plan("w").unwrap().as_str());
            let TrialPlan { episode_id, step: published, model, plan } =
                wire::decode(&sample.payload().to_bytes()).unwrap();
            assert_eq!((episode_id.as_str(), published, model.as_str()), ("e", *step, "cpn"));
            assert_eq!(wire::encode(plan), wire::encode(response.clone()), "NaN equals itself");
        }
        assert!(watcher.try_recv().unwrap().is_none());
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn faults_are_told_apart() {
        let (link, _) = forgetful().await;
        let fault = async |worker: &str, digest: &str, variation: Variation| {
            attempt(&link, &with(worker), &model(digest), &variation, &default_run()).await.unwrap_err()
        };
        // The expert solves none of the variations whose goal could be shown.
        let ablation = run(GoalSource::OtherVariation, Planning::default());
        let other = attempt(&link, &with("w"), &model(DIGEST), &variation("reach", 99), &ablation).await;
        assert!(matches!(other, Err(Fault::NoGoalImage)));
        // It solves seed 12, not 13, and the one after, whose goal is shown instead.
        attempt(&link, &with("w"), &model(DIGEST), &variation("reach", 12), &ablation).await.unwrap();
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

    #[tokio::test(flavor = "multi_thread")]
    async fn plans_are_searched_for_and_carried_out_as_set() {
        let (link, _) = forgetful().await;
        let planned = async |planning: Planning| {
            let run = run(GoalSource::SameVariation, planning);
            let attempt = attempt(&link, &with("w"), &model(DIGEST), &variation("reach", 1), &run).await.unwrap();
            let tenths = |value: &f64| (10.0 * value).round() as i32;
            let applied: Vec<_> = attempt.episode.progress[1..].iter().map(tenths).collect();
            (applied, attempt.episode.plan_steps, attempt.recording)
        };
        let default = Planning::default();
        let (applied, _, recording) = planned(Planning { updates: Some(20), ..default }).await;
        assert_eq!(applied, [0, 3, 5]);
        assert!(recording.exchanges().iter().all(|exchange| exchange.response.iterations_run == 20));
        // Each plan begins one action further on.
        let (applied, steps, recording) = planned(Planning { warm_start: true, ..default }).await;
        assert_eq!((applied, steps), (vec![0, 1, 2], vec![]));
        assert!(recording.exchanges().iter().all(|exchange| exchange.request.search.is_none()));
        // An approach goes on with each plan, but not beside a warm start.
        let approaches = |recording: Recording| -> Vec<_> {
            recording
                .exchanges()
                .iter()
                .map(|exchange| exchange.request.approach.map(|approach| approach.plans))
                .collect()
        };
        assert_eq!(approaches(recording), [None; 3]);
        assert_eq!(approaches(planned(default).await.2), [None, Some(1), Some(2)]);
        assert_eq!(approaches(planned(Planning { no_approaches: true, ..default }).await.2), [None; 3]);
        // Two actions of the first plan, then the second plan, from the third action on.
        let (applied, steps, recording) = planned(Planning { apply_actions: 2, warm_start: true, ..default }).await;
        assert_eq!((applied, steps, recording.exchanges().len()), (vec![0, 1, 2], vec![0, 2], 2));
        let tenths = |action: &Vec<f32>| (10.0 * action[0]).round() as i32;
        assert_eq!(recording.exchanges()[1].request.warm_start.iter().map(tenths).collect::<Vec<_>>(), [2, 2, 2]);
        // The steps left are counted from those of the episode, or of the task.
        let steps_left = |recording: Recording| -> Vec<_> {
            recording.exchanges().iter().map(|exchange| exchange.request.steps_left.unwrap()).collect()
        };
        assert_eq!(steps_left(planned(default).await.2), [5, 4, 3]);
        assert_eq!(steps_left(planned(Planning { apply_actions: 2, ..default }).await.2), [5, 3]);
        assert_eq!(steps_left(planned(Planning { task_steps: Some(2), ..default }).await.2), [2, 1, 1]);
        // A plan takes half a second here, five steps of the simulation: none acts before the episode ends.
        let (applied, steps, recording) = planned(Planning { real_time: true, ..default }).await;
        assert_eq!((applied, steps, recording.exchanges().len()), (vec![0, 0, 0], vec![], 1));
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn controls_ask_no_planner_and_solved_variations_are_not_attempted() {
        let (link, registered) = forgetful().await;
        let services = Services { planner: "nobody".into(), worker: "w".into() };
        for (control, applied) in [(Control::NoOp, [0.0; 3]), (Control::Oracle, [1.0; 3])] {
            let attempt =
                attempt(&link, &services, &control.model(), &variation("reach", 1), &default_run()).await.unwrap();
            assert_eq!((attempt.recording.exchanges().len(), attempt.recording.frames().len()), (0, 4));
            assert_eq!(attempt.episode.steps, 3);
            assert_eq!(attempt.episode.progress[1..], applied);
            assert_eq!(attempt.episode.goal_id, image(255).digest());
        }
        let solved = attempt(&link, &with("w"), &model(DIGEST), &variation("reach", 50), &default_run()).await;
        assert!(matches!(solved, Err(Fault::SolvedAtReset)));
        assert_eq!(registered.load(Ordering::SeqCst), 0);
    }
}
