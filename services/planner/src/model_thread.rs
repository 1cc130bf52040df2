//! The one thread that owns every model. Plans wait for it in a bounded queue; a swap takes effect between two plans.

use crate::config::Config;
use crate::model::Model;
use crate::served::Served;
use lru::LruCache;
use std::any::Any;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use std::{io, thread};
use tch::Tensor;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot, watch};
use tracing::error;
use wire::planner::{ModelInfo, PlanResponse, StageTimes};
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
}

impl PlanTask {
    /// The request's field that the observation came from.
    fn observation_field(&self) -> &'static str {
        match self.observation {
            Observation::Image(_) => "observation",
            Observation::Position(_) => "position",
        }
    }
}

/// The caller's side of the thread.
#[derive(Debug, Clone)]
pub(crate) struct ModelThread {
    /// In order and unbounded: what bounds the waiting plans is `places`, so that a swap always finds room.
    jobs: mpsc::Sender<Job>,
    places: Arc<Semaphore>,
    capacity: u16,
    models: watch::Receiver<BTreeMap<String, ModelInfo>>,
}

#[derive(Debug)]
enum Job {
    Plan {
        task: PlanTask,
        enqueued: Instant,
        /// Given back when the plan starts.
        place: OwnedSemaphorePermit,
        reply: oneshot::Sender<Result<PlanResponse, Error>>,
    },
    Serve {
        model: Model,
        reply: oneshot::Sender<()>,
    },
    Stop,
}

impl ModelThread {
    /// Starts the thread with these models.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub(crate) fn start(config: &Config, models: Vec<Model>) -> io::Result<Self> {
        let (sender, receiver) = mpsc::channel();
        let infos = models.iter().map(|model| (model.info.name.clone(), model.info.clone())).collect();
        let (published, subscribed) = watch::channel(infos);
        let owner = Owner {
            models: Served::new(models, config.retired_capacity.into()),
            embeddings: LruCache::new(config.goal_capacity.into()),
            published,
        };
        let threads = config.threads.get();
        thread::Builder::new().name("model".into()).spawn(move || {
            tch::set_num_threads(threads.into());
            owner.run(&receiver);
        })?;
        let capacity = config.queue_capacity.get();
        let places = Arc::new(Semaphore::new(capacity.into()));
        Ok(Self { jobs: sender, places, capacity, models: subscribed })
    }

    /// Waits in the queue and plans.
    ///
    /// # Errors
    /// If the queue is full, the deadline passes, the thread has stopped, or planning fails.
    pub(crate) async fn plan(&self, task: PlanTask) -> Result<PlanResponse, Error> {
        let enqueued = Instant::now();
        let place = Arc::clone(&self.places).try_acquire_owned().map_err(|_| queue_full(self.capacity))?;
        let deadline = task.deadline;
        let (reply, answer) = oneshot::channel();
        self.jobs.send(Job::Plan { task, enqueued, place, reply }).map_err(|_| stopped())?;
        let answer = match deadline {
            Some(deadline) => {
                tokio::time::timeout_at((enqueued + deadline).into(), answer).await.map_err(|_| too_late(deadline))?
            }
            None => answer.await,
        };
        answer.map_err(|_| stopped())?
    }

    /// Serves a model, in place of the one of its name, from the next plan on.
    ///
    /// # Errors
    /// If the thread has stopped.
    pub(crate) async fn serve(&self, model: Model) -> Result<(), Error> {
        let (reply, done) = oneshot::channel();
        self.jobs.send(Job::Serve { model, reply }).map_err(|_| stopped())?;
        done.await.map_err(|_| stopped())
    }

    /// The models being served, by name.
    pub(crate) fn models(&self) -> watch::Ref<'_, BTreeMap<String, ModelInfo>> {
        self.models.borrow()
    }

    /// Lets the thread finish what is waiting and end; every later request is refused.
    pub(crate) async fn stop(&self) {
        // The thread has ended when its side of the channel is gone, which it may be already.
        let mut models = self.models.clone();
        if self.jobs.send(Job::Stop).is_ok() {
            while models.changed().await.is_ok() {}
        }
    }
}

/// A queue of `capacity` has no free place.
pub(crate) fn queue_full(capacity: u16) -> Error {
    Error::new(Code::ResourceExhausted, "queue", "a free place", format!("{capacity} waiting"))
}

fn stopped() -> Error {
    Error::new(Code::Unavailable, "planner", "a running planner", "one that is shutting down")
}

fn too_late(deadline: Duration) -> Error {
    Error::new(Code::DeadlineExceeded, "deadline_ms", format!("an answer within {} ms", deadline.as_millis()), "none")
}

/// The thread's side.
struct Owner {
    models: Served,
    /// Goal embeddings `[1, Z]` by goal and checkpoint, so that those of a swapped-out model are never used.
    embeddings: LruCache<(String, String), Tensor>,
    published: watch::Sender<BTreeMap<String, ModelInfo>>,
}

impl Owner {
    fn run(mut self, jobs: &mpsc::Receiver<Job>) {
        for job in jobs {
            match job {
                Job::Plan { task, enqueued, place, reply } => {
                    drop(place);
                    // A client that gave up has closed its end.
                    if !reply.is_closed() {
                        let _ = reply.send(self.answer(&task, enqueued));
                    }
                }
                Job::Serve { model, reply } => {
                    let (name, info) = (model.info.name.clone(), model.info.clone());
                    self.models.swap_in(model);
                    self.published.send_modify(|infos| drop(infos.insert(name, info)));
                    let _ = reply.send(());
                }
                Job::Stop => return,
            }
        }
    }

    /// Answers a request whatever happens: a fault of one does not end the thread.
    fn answer(&mut self, task: &PlanTask, enqueued: Instant) -> Result<PlanResponse, Error> {
        let queued = enqueued.elapsed();
        if let Some(deadline) = task.deadline.filter(|deadline| queued >= *deadline) {
            return Err(too_late(deadline));
        }
        let mut response = catch_unwind(AssertUnwindSafe(|| self.plan(task))).unwrap_or_else(|panic| {
            let reason = panic_message(&*panic);
            error!(model = task.model, reason, "planning panicked");
            Err(Error::new(Code::Internal, "plan", "a plan", reason))
        })?;
        response.times.queue_seconds = queued.as_secs_f64();
        Ok(response)
    }

    fn plan(&mut self, task: &PlanTask) -> Result<PlanResponse, Error> {
        let model = self.models.get(&task.model, task.model_digest.as_deref())?;
        model.check_takes(task.goal_field, &task.goal)?;
        model.check_takes(task.observation_field(), &task.observation)?;
        check_render_specs(task, &model.render_spec)?;
        let started = Instant::now();
        // One by one: in a batch an embedding could differ, in its last bits, with what else is in the batch.
        let x = model.encode(&task.observation);
        let key = (task.goal_id.clone(), model.info.digest.clone());
        let x_g = self.embeddings.get_or_insert(key, || model.encode(&task.goal));
        let encoded = Instant::now();
        let planned = model.plan(&x, x_g, task.seed)?;
        let first_action = planned.actions.first().into_iter().flatten().map(|v| v.clamp(-1.0, 1.0)).collect();
        Ok(PlanResponse {
            first_action,
            actions: planned.actions,
            inner_losses: planned.inner_losses,
            latent_distance: planned.latent_distance,
            times: StageTimes {
                encode_seconds: (encoded - started).as_secs_f64(),
                plan_seconds: encoded.elapsed().as_secs_f64(),
                ..StageTimes::default()
            },
            model_digest: model.info.digest.clone(),
            goal_id: task.goal_id.clone(),
            iterations: 0,
            iterations_run: 0,
            warm_start: Vec::new(),
        })
    }
}

/// A plan is only worth something between pictures of one look, and by a model that learnt from that look. What does not
/// say how it was rendered goes with everything.
fn check_render_specs(task: &PlanTask, model: &str) -> Result<(), Error> {
    let (observation, goal) = (task.observation.render_spec(), task.goal.render_spec());
    let expected = [model, goal].into_iter().find(|spec| !spec.is_empty()).unwrap_or(observation);
    let goal_field = if task.goal_field == "goal_image" { "goal_image.render_spec" } else { task.goal_field };
    for (field, got) in [(goal_field, goal), ("observation.render_spec", observation)] {
        if !got.is_empty() && got != expected {
            return Err(Error::new(Code::FailedPrecondition, field, expected, got));
        }
    }
    Ok(())
}

/// What a panic says; `tch` panics with the message of libtorch.
fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic")
}
