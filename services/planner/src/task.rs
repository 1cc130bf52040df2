//! A request to plan on its way to the model.

use crate::load::Estimate;
use crate::outbox::Outbox;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::{OwnedSemaphorePermit, oneshot};
use tracing::Span;
use wire::planner::{PlanResponse, Search, Solver};
use wire::{Code, Error, Observation};

/// A request to plan whose names are resolved and whose images are of the right size.
#[derive(Debug)]
pub(crate) struct PlanTask {
    pub(crate) model: String,
    /// The checkpoint that must answer.
    pub(crate) model_digest: Option<String>,
    pub(crate) goal_id: String,
    pub(crate) goal: Arc<Observation>,
    /// The request's field that the goal came from.
    pub(crate) goal_field: &'static str,
    pub(crate) observation: Observation,
    pub(crate) seed: u64,
    pub(crate) deadline: Option<Duration>,
    pub(crate) search: Option<Search>,
    /// `[H][A]`, or nothing.
    pub(crate) warm_start: Vec<Vec<f32>>,
    /// Of the request.
    pub(crate) span: Span,
}

/// A task in the queue.
#[derive(Debug)]
pub(crate) struct Waiting {
    pub(crate) task: PlanTask,
    pub(crate) enqueued: Instant,
    /// Of its time in the queue.
    pub(crate) queued: Span,
    /// Given back when the plan starts or, if it is done in pieces, when it is answered.
    pub(crate) place: OwnedSemaphorePermit,
    pub(crate) reply: Reply,
    pub(crate) estimate: Estimate,
}

/// A task that is being planned for.
#[derive(Debug)]
pub(crate) struct Accepted {
    pub(crate) task: PlanTask,
    pub(crate) enqueued: Instant,
    pub(crate) reply: Reply,
    pub(crate) estimate: Estimate,
    pub(crate) _place: Option<OwnedSemaphorePermit>,
}

/// What a task comes to.
pub(crate) type Answer = Result<PlanResponse, Error>;

/// Where the answer goes.
pub(crate) enum Reply {
    /// To who awaits it, or has given up.
    Awaited(oneshot::Sender<Answer>),
    /// To what is called with it and may block.
    Called(Box<dyn FnOnce(Answer) + Send>, Outbox),
}

impl PlanTask {
    /// Whether both can be planned together.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        let kind = |task: &Self| (task.search, task.warm_start.is_empty());
        self.model == other.model && self.model_digest == other.model_digest && kind(self) == kind(other)
    }

    /// Whether the plan goes on until its own deadline, so that nobody can share it.
    pub(crate) fn is_anytime(&self) -> bool {
        self.search.is_some_and(|search| search.anytime)
    }

    /// Whether plans are tried, so that planning together saves nothing.
    pub(crate) fn is_sampled(&self) -> bool {
        self.search.is_some_and(|search| search.solver != Solver::Gradient)
    }

    /// The request's field that the observation came from.
    pub(crate) fn observation_field(&self) -> &'static str {
        match self.observation {
            Observation::Image(_) => "observation",
            Observation::Position(_) => "position",
        }
    }

    /// A plan is only worth something between pictures of one look, and by a model that learnt from that look. What does
    /// not say how it was rendered goes with everything.
    ///
    /// # Errors
    /// If two of the three were rendered differently.
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
    /// Whether nobody waits for the answer any more.
    pub(crate) fn is_given_up(&self) -> bool {
        matches!(self, Self::Awaited(sender) if sender.is_closed())
    }

    /// Whether it may take long to send the answer from the same thread.
    pub(crate) fn may_block(&self) -> bool {
        matches!(self, Self::Called(..))
    }

    /// Hands the answer over, and does not block.
    pub(crate) fn send(self, answer: Answer) {
        match self {
            Self::Awaited(sender) => drop(sender.send(answer)),
            Self::Called(call, outbox) => outbox.put(move || call(answer)),
        }
    }

    /// The same without another thread: what is called may block this one.
    pub(crate) fn send_here(self, answer: Answer) {
        match self {
            Self::Called(call, _) => call(answer),
            awaited => awaited.send(answer),
        }
    }
}

impl fmt::Debug for Reply {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.is_given_up() { "Reply(given up)" } else { "Reply" })
    }
}

impl Waiting {
    /// When the answer is no longer of use.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.task.deadline.map(|deadline| self.enqueued + deadline)
    }
}

/// A queue of `capacity` has no free place.
pub(crate) fn queue_full(capacity: u16) -> Error {
    Error::new(Code::ResourceExhausted, "queue", "a free place", format!("{capacity} waiting"))
}

/// Whoever waits so long gets nothing of use.
pub(crate) fn too_many(deadline: Duration, wait: Duration) -> Error {
    let expected = format!("a wait of less than the deadline of {} ms", deadline.as_millis());
    Error::new(Code::ResourceExhausted, "queue", expected, format!("about {} ms", wait.as_millis()))
}

pub(crate) fn too_late(deadline: Duration) -> Error {
    Error::new(Code::DeadlineExceeded, "deadline_ms", format!("an answer within {} ms", deadline.as_millis()), "none")
}

/// A search that takes so long in any case is not begun.
pub(crate) fn too_long(deadline: Duration, least: Duration) -> Error {
    let expected = format!("one that takes less than the deadline of {} ms", deadline.as_millis());
    Error::new(Code::ResourceExhausted, "search", expected, format!("{} ms or more", least.as_millis()))
}

pub(crate) fn stopped() -> Error {
    Error::new(Code::Unavailable, "planner", "a running planner", "one that is shutting down")
}
