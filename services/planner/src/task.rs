//! Plan requests in the queue of the model thread, their replies and errors.

use crate::load::Estimate;
use crate::outbox::Outbox;
use cpn::Approach;
use cpn::method::Query;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, oneshot};
use tracing::Span;
use wire::planner::{self, PlanResponse, Search, Solver};
use wire::{Code, Error, Observation};

/// Plan request with resolved names and checked image sizes.
#[derive(Debug)]
pub(crate) struct PlanTask {
    pub(crate) model: String,
    /// SHA-256 of the required checkpoint, in hex.
    pub(crate) model_digest: Option<String>,
    pub(crate) goal_id: String,
    pub(crate) goal: Arc<Observation>,
    /// Name of the request's field with the goal.
    pub(crate) goal_field: &'static str,
    pub(crate) observation: Observation,
    pub(crate) seed: u64,
    pub(crate) deadline: Option<Duration>,
    pub(crate) search: Option<Search>,
    /// Initial plan, `[H, A]` or empty.
    pub(crate) warm_start: Vec<Vec<f32>>,
    /// Number of steps that remain for the task.
    pub(crate) steps_left: Option<u32>,
    /// Approach of the episode, from the response before.
    pub(crate) approach: Option<Approach>,
    /// Tracing span of the request.
    pub(crate) span: Span,
}

/// Task in the queue.
#[derive(Debug)]
pub(crate) struct Waiting {
    pub(crate) task: PlanTask,
    pub(crate) enqueued: Instant,
    /// Tracing span of the time in the queue.
    pub(crate) queued: Span,
    /// Place in the queue, freed when the plan starts or, for a sliced search, when it is answered.
    pub(crate) place: OwnedSemaphorePermit,
    pub(crate) reply: Reply,
    pub(crate) estimate: Estimate,
}

/// Task being planned.
#[derive(Debug)]
pub(crate) struct Accepted {
    pub(crate) task: PlanTask,
    pub(crate) enqueued: Instant,
    pub(crate) reply: Reply,
    pub(crate) estimate: Estimate,
    pub(crate) _place: Option<OwnedSemaphorePermit>,
}

/// Answer to a task.
pub(crate) type Answer = Result<PlanResponse, Error>;

/// Destination of an answer.
pub(crate) enum Reply {
    /// Channel of a caller that awaits the answer; closed if it was cancelled.
    Channel(oneshot::Sender<Answer>),
    /// Callback that may block, and the outbox to call it from.
    Callback(Box<dyn FnOnce(Answer) + Send>, Outbox),
}

/// Embedding of a goal by a checkpoint.
#[derive(Debug, Clone, Default)]
pub(crate) struct GoalEmbedding {
    /// x_g, `[Z]`.
    pub(crate) x_g: Vec<f32>,
    /// Whether the checkpoint was trained on goals like it.
    pub(crate) is_familiar: bool,
}

/// Approach of a request.
pub(crate) fn approach_from_wire(planner::Approach { tried, position, plans }: planner::Approach) -> Approach {
    Approach { tried, position, plans }
}

/// Approach of a response.
pub(crate) fn approach_to_wire(Approach { tried, position, plans }: Approach) -> planner::Approach {
    planner::Approach { tried, position, plans }
}

/// Embeddings of a task's observation and goal, and the target of its plan.
#[derive(Debug)]
pub(crate) struct Latents {
    /// x, `[Z]`.
    pub(crate) x: Vec<f32>,
    pub(crate) goal: GoalEmbedding,
    /// Approach, of a model with position dynamics and a task without a search and a warm start.
    pub(crate) approach: Option<Approach>,
    /// Embedding to plan towards, `[Z]`: x_g, or that with the position of the approach's target.
    towards: Vec<f32>,
}

impl Latents {
    /// Embeddings of a task, with its approach if the model has position dynamics.
    pub(crate) fn new(task: &PlanTask, x: Vec<f32>, goal: GoalEmbedding, moves_positions: bool) -> Self {
        let approach = (moves_positions && task.has_default_search()).then(|| match task.approach {
            Some(approach) => approach.next(&x, &goal.x_g, goal.is_familiar),
            None => Approach::first(&x),
        });
        let towards =
            approach.map_or_else(|| goal.x_g.clone(), |approach| approach.towards(&goal.x_g, goal.is_familiar));
        Self { x, goal, approach, towards }
    }

    /// Whether the policy's plan is kept: for a familiar goal, unless the approach has left it.
    fn keeps_policy(&self) -> bool {
        let GoalEmbedding { is_familiar, .. } = self.goal;
        self.approach.map_or(is_familiar, |approach| approach.keeps_policy(is_familiar))
    }
}

impl PlanTask {
    /// Query of the task, from its embeddings. For a familiar goal the policy's plan is kept, unless the request names a search or an
    /// initial plan.
    pub(crate) fn query<'a>(&'a self, latents: &'a Latents) -> Query<'a> {
        Query {
            x: &latents.x,
            x_g: &latents.towards,
            // Checked for methods that take it.
            steps_left: self.steps_left.unwrap_or_default(),
            seed: self.seed,
            start: &self.warm_start,
            keep_initial: self.has_default_search() && latents.keeps_policy(),
        }
    }

    /// Whether the request leaves the search to the model: it names none, and has no warm start.
    fn has_default_search(&self) -> bool {
        self.search.is_none() && self.warm_start.is_empty()
    }

    /// Whether both tasks fit in one batch: same model, checkpoint, search and kind of start.
    pub(crate) fn is_compatible(&self, other: &Self) -> bool {
        let kind = |task: &Self| (task.search, task.warm_start.is_empty());
        self.model == other.model && self.model_digest == other.model_digest && kind(self) == kind(other)
    }

    /// Whether the search is anytime: it ends with the task's own deadline, and cannot be batched.
    pub(crate) fn is_anytime(&self) -> bool {
        self.search.is_some_and(|search| search.anytime)
    }

    /// Whether the search samples plans; batching such tasks saves nothing.
    pub(crate) fn is_sampled(&self) -> bool {
        self.search.is_some_and(|search| search.solver != Solver::Gradient)
    }

    /// Name of the request's field with the observation.
    pub(crate) fn observation_field(&self) -> &'static str {
        match self.observation {
            Observation::Image(_) => "observation",
            Observation::Position(_) => "position",
        }
    }

    /// Checks that observation, goal and the model's training images have the same render spec; an empty one matches any.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION` if two of the three differ.
    pub(crate) fn check_render_specs(&self, model: &str) -> Result<(), Error> {
        let (observation, goal) = (self.observation.render_spec(), self.goal.render_spec());
        let expected = [model, goal].into_iter().find(|spec| !spec.is_empty()).unwrap_or(observation);
        let goal_field = if self.goal_field == "goal_image" { "goal_image.render_spec" } else { self.goal_field };
        for (field, got) in [(goal_field, goal), ("observation.render_spec", observation)] {
            if !got.is_empty() && got != expected {
                return Err(Error::new(Code::FailedPrecondition, field, expected, got));
            }
        }
        Ok(())
    }
}

impl Reply {
    /// Whether the caller no longer awaits the answer.
    pub(crate) fn is_cancelled(&self) -> bool {
        matches!(self, Self::Channel(sender) if sender.is_closed())
    }

    /// Whether [`Self::send_here`] may block.
    pub(crate) fn may_block(&self) -> bool {
        matches!(self, Self::Callback(..))
    }

    /// Sends the answer without blocking, a callback's by its outbox.
    pub(crate) fn send(self, answer: Answer) {
        match self {
            Self::Channel(sender) => drop(sender.send(answer)),
            Self::Callback(call, outbox) => outbox.put(move || call(answer)),
        }
    }

    /// Sends the answer on this thread, which a callback may block.
    pub(crate) fn send_here(self, answer: Answer) {
        match self {
            Self::Callback(call, _) => call(answer),
            awaited => awaited.send(answer),
        }
    }
}

impl fmt::Debug for Reply {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.is_cancelled() { "Reply(cancelled)" } else { "Reply" })
    }
}

impl Waiting {
    /// Instant of the deadline.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.task.deadline.map(|deadline| self.enqueued + deadline)
    }
}

/// Refused: all `capacity` places of the queue are taken.
pub(crate) fn queue_full(capacity: u16) -> Error {
    Error::new(Code::ResourceExhausted, "queue", "a free place", format!("{capacity} waiting"))
}

/// Refused: the expected wait exceeds the deadline.
pub(crate) fn wait_too_long(deadline: Duration, wait: Duration) -> Error {
    let expected = format!("a wait of less than the deadline of {} ms", deadline.as_millis());
    Error::new(Code::ResourceExhausted, "queue", expected, format!("about {} ms", wait.as_millis()))
}

/// The deadline has passed.
pub(crate) fn deadline_exceeded(deadline: Duration) -> Error {
    Error::new(Code::DeadlineExceeded, "deadline_ms", format!("an answer within {} ms", deadline.as_millis()), "none")
}

/// Refused: the search alone takes longer than the deadline, even at the fastest speed measured.
pub(crate) fn search_too_long(deadline: Duration, least: Duration) -> Error {
    let expected = format!("one that takes less than the deadline of {} ms", deadline.as_millis());
    Error::new(Code::ResourceExhausted, "search", expected, format!("{} ms or more", least.as_millis()))
}

/// Refused: the planner is shutting down.
pub(crate) fn shutting_down() -> Error {
    Error::new(Code::Unavailable, "planner", "a running planner", "one that is shutting down")
}
