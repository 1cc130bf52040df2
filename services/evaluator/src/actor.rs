//! Choice of the actions of an episode: by a control, or by a model that a planner is asked for.

use crate::control::Control;
use crate::link::Link;
use crate::planning::Planning;
use crate::presence::Service;
use crate::record::Model;
use crate::trial::Fault;
use recording::trial::Exchange;
use std::time::Instant;
use wire::planner::{Approach, Goal, PlanRequest, PlanResponse, RegisterGoalRequest, RegisterGoalResponse};
use wire::sim::ResetResponse;
use wire::{Code, Error, Image, Observation, Position, key};

/// Source of an episode's actions: a planner or a control.
pub(crate) enum Actor<'a> {
    Control(Control),
    Planned(Box<Planned<'a>>),
}

/// Actions to apply before the next are chosen, at least one.
pub(crate) struct Decided {
    pub(crate) actions: Vec<Vec<f32>>,
    /// Time that the choice took.
    pub(crate) thinking_seconds: f64,
}

impl<'a> Actor<'a> {
    /// The actor of a model in a new episode; registers the goal with a planner.
    pub(crate) async fn new(
        link: &'a Link,
        planner: Service,
        model: &'a Model,
        planning: &'a Planning,
        seed: u64,
        reset: &ResetResponse,
        start: Instant,
    ) -> Result<Self, Fault> {
        if let Some(control) = Control::of(model) {
            return Ok(Self::Control(control));
        }
        let goal = link.goal(&planner, reset).await.map_err(|error| Fault::new(planner.clone(), error))?;
        let (warm_start, approach, exchanges) = (Vec::new(), None, Vec::new());
        let planned = Planned { link, planner, model, planning, seed, start, goal, warm_start, approach, exchanges };
        Ok(Self::Planned(Box::new(planned)))
    }

    /// The next actions, chosen before a step that comes after `step` others.
    pub(crate) async fn decide(
        &mut self,
        reset: &ResetResponse,
        step: u32,
        frame: &Image,
        hand: Position,
    ) -> Result<Decided, Fault> {
        match self {
            Self::Control(control) => Ok(Decided { actions: vec![control.action(reset, hand)], thinking_seconds: 0.0 }),
            Self::Planned(planner) => planner.decide(reset, step, observed(reset, frame, hand)).await,
        }
    }

    /// The latest plan request with its answer; none of a control.
    pub(crate) fn latest(&self) -> Option<&Exchange> {
        match self {
            Self::Control(_) => None,
            Self::Planned(planner) => planner.exchanges.last(),
        }
    }

    /// Plan requests with their answers; none of a control.
    pub(crate) fn exchanges(self) -> Vec<Exchange> {
        match self {
            Self::Control(_) => Vec::new(),
            Self::Planned(planner) => planner.exchanges,
        }
    }
}

/// A model that a planner is asked for.
pub(crate) struct Planned<'a> {
    link: &'a Link,
    planner: Service,
    model: &'a Model,
    planning: &'a Planning,
    /// Of the variation.
    seed: u64,
    /// Start of the episode.
    start: Instant,
    goal: Goal,
    /// Initial actions of the next search; the policy's if empty.
    warm_start: Vec<Vec<f32>>,
    /// Approach of the next plan.
    approach: Option<Approach>,
    exchanges: Vec<Exchange>,
}

impl Planned<'_> {
    async fn decide(&mut self, reset: &ResetResponse, step: u32, observation: Observation) -> Result<Decided, Fault> {
        let by_planner = |error| Fault::new(self.planner.clone(), error);
        let (goal, seed) = (self.goal.clone(), plan_seed(self.seed, step));
        let steps_left = self.planning.steps_left(reset.max_steps, step);
        let request = self.link.plan_request(self.model, self.planning, goal, observation, seed, steps_left);
        let warm_start = std::mem::take(&mut self.warm_start);
        let request = PlanRequest { warm_start, approach: self.approach, ..request };

        let asked = self.start.elapsed();
        let mut plan = self.link.plan(&self.planner, request.clone()).await;
        if plan.as_ref().is_err_and(|e| e.code == Code::NotFound && e.field == "goal_id") {
            // The planner was restarted, or has evicted the goal.
            self.link.register_goal(&self.planner, &reset.goal).await.map_err(by_planner)?;
            plan = self.link.plan(&self.planner, request.clone()).await;
        }
        let response = plan.map_err(by_planner)?;

        let applied = self.planning.apply_actions as usize;
        let later = response.actions.iter().take(applied).skip(1);
        let later = later.map(|action| action.iter().map(|value| value.clamp(-1.0, 1.0)).collect());
        let actions = std::iter::once(response.first_action.clone()).chain(later).collect();
        if self.planning.warm_start {
            self.warm_start = moved_on(response.warm_start.clone(), applied - 1);
        } else if !self.planning.no_approaches {
            self.approach = response.approach;
        }
        let times = response.times;
        self.exchanges.push(Exchange { step, request, asked, response, answered: self.start.elapsed() });
        Ok(Decided { actions, thinking_seconds: times.queue_seconds + times.encode_seconds + times.plan_seconds })
    }
}

/// A plan moved on by so many more steps, its last action repeated.
fn moved_on(mut plan: Vec<Vec<f32>>, steps: usize) -> Vec<Vec<f32>> {
    let horizon = plan.len();
    plan.drain(..steps.min(horizon.saturating_sub(1)));
    if let Some(last) = plan.last().cloned() {
        plan.resize(horizon, last);
    }
    plan
}

/// Seed of the plan before a step: no two steps of an evaluation share one.
pub(crate) fn plan_seed(variation: u64, step: u32) -> u64 {
    (variation << 16) + u64::from(step)
}

/// Observation for a model: the hand's position if the goal is a position, else the image.
pub(crate) fn observed(reset: &ResetResponse, frame: &Image, hand: Position) -> Observation {
    if reset.goal_position.is_some() { hand.into() } else { frame.clone().into() }
}

impl Link {
    /// The goal of an episode as the planner is told it: a position, or the id of a picture that it gets to know.
    pub(crate) async fn goal(&self, planner: &Service, reset: &ResetResponse) -> Result<Goal, Error> {
        Ok(match reset.goal_position {
            Some(position) => Goal::Position(position),
            None => Goal::Id(self.register_goal(planner, &reset.goal).await?),
        })
    }

    pub(crate) fn plan_request(
        &self,
        model: &Model,
        planning: &Planning,
        goal: Goal,
        observation: Observation,
        seed: u64,
        steps_left: u32,
    ) -> PlanRequest {
        PlanRequest {
            search: planning.search().filter(|_| model.plans()),
            seed,
            deadline: Some(self.timeout),
            // The one that the run began with, though the planner may swap.
            model_digest: Some(model.digest.clone()),
            // Of every model: those that do not take it ignore it.
            steps_left: Some(steps_left),
            ..PlanRequest::new(&model.name, goal, observation)
        }
    }

    pub(crate) async fn plan(&self, planner: &Service, request: PlanRequest) -> Result<PlanResponse, Error> {
        self.call(planner, key::planner_plan(planner.name())?, request).await
    }

    async fn register_goal(&self, planner: &Service, goal: &Image) -> Result<String, Error> {
        let request = RegisterGoalRequest { image: goal.clone() };
        let key = key::planner_register_goal(planner.name())?;
        let response: RegisterGoalResponse = self.call(planner, key, request).await?;
        Ok(response.goal_id)
    }
}
