//! The caller's side of the one thread that owns every model. Plans wait for it in a bounded queue; a swap takes effect
//! between two plans.

use crate::config::Config;
use crate::load::Load;
use crate::model::Model;
use crate::owner::Owner;
use crate::task::{Answer, PlanTask, Reply, Waiting, queue_full, too_late, too_many};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::mpsc::{self, SendError};
use std::time::Instant;
use std::{io, thread};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot, watch};
use tracing::debug_span;
use wire::planner::ModelInfo;
use wire::{Code, Error};

/// The caller's side of the thread.
#[derive(Debug, Clone)]
pub(crate) struct ModelThread {
    /// In order and unbounded: what bounds the waiting plans is `places`, so that a swap always finds room.
    jobs: mpsc::Sender<Job>,
    places: Arc<Semaphore>,
    capacity: u16,
    load: Arc<Load>,
    models: watch::Receiver<BTreeMap<String, ModelInfo>>,
}

/// What the thread is asked to do.
#[derive(Debug)]
pub(crate) enum Job {
    Plan(Waiting),
    Serve { model: Model, reply: oneshot::Sender<()> },
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
        let load = Arc::new(Load::default());
        let threads = config.threads.get();
        let owner = Owner::new(config, models, published, Arc::clone(&load));
        thread::Builder::new().name("model".into()).spawn(move || {
            tch::set_num_threads(threads.into());
            owner.run(&receiver);
        })?;
        let capacity = config.queue_capacity.get();
        let places = Arc::new(Semaphore::new(capacity.into()));
        Ok(Self { jobs: sender, places, capacity, load, models: subscribed })
    }

    /// Waits in the queue and plans.
    ///
    /// # Errors
    /// If the queue is full, or so long that the deadline would pass; if it does pass, the thread has stopped, or planning
    /// fails.
    pub(crate) async fn plan(&self, task: PlanTask) -> Answer {
        let due = task.deadline.map(|deadline| (Instant::now() + deadline, deadline));
        let (reply, answer) = oneshot::channel();
        self.enqueue(task, Reply::Awaited(reply));
        let answer = match due {
            Some((due, deadline)) => {
                tokio::time::timeout_at(due.into(), answer).await.map_err(|_| too_late(deadline))?
            }
            None => answer.await,
        };
        answer.map_err(|_| stopped())?
    }

    /// Puts a task in the queue, or replies at once: if the queue is full, or so long that the deadline would pass, or the
    /// thread has stopped.
    pub(crate) fn enqueue(&self, task: PlanTask, reply: Reply) {
        let enqueued = Instant::now();
        let place = match self.admit(&task) {
            Ok(place) => place,
            Err(error) => return reply.send(Err(error)),
        };
        self.load.begin();
        let queued = debug_span!(parent: &task.span, "queue");
        let job = Job::Plan(Waiting { task, enqueued, queued, place, reply });
        if let Err(SendError(Job::Plan(Waiting { reply, .. }))) = self.jobs.send(job) {
            reply.send(Err(stopped()));
        }
    }

    /// A place in the queue, if the answer can come in time.
    fn admit(&self, task: &PlanTask) -> Result<OwnedSemaphorePermit, Error> {
        let place = Arc::clone(&self.places).try_acquire_owned().map_err(|_| queue_full(self.capacity))?;
        let wait = self.load.time(self.load.tasks() + 1);
        if let Some(deadline) = task.deadline.filter(|deadline| wait > *deadline && self.load.tasks() > 0) {
            return Err(too_many(deadline, wait));
        }
        Ok(place)
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

fn stopped() -> Error {
    Error::new(Code::Unavailable, "planner", "a running planner", "one that is shutting down")
}
