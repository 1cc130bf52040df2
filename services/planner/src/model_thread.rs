//! The caller's side of the one thread that owns every model. Plans wait for it in a bounded queue; a swap takes effect
//! between two plans.

use crate::config::Config;
use crate::load::{Estimate, Load};
use crate::model::Model;
use crate::owner::Owner;
use crate::task::{Answer, PlanTask, Reply, Waiting, queue_full, stopped, too_late, too_long, too_many};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::mpsc::{self, SendError};
use std::time::Instant;
use std::{io, thread};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot, watch};
use tracing::debug_span;
use wire::Error;
use wire::planner::ModelInfo;

/// The caller's side of the thread.
#[derive(Debug, Clone)]
pub(crate) struct ModelThread {
    /// In order and unbounded: what bounds the waiting plans is `places`, so that a swap always finds room.
    jobs: mpsc::Sender<Job>,
    places: Arc<Semaphore>,
    capacity: u16,
    /// The same for searches that are done in pieces, until they are answered: half as many.
    searches: Arc<Semaphore>,
    load: Arc<Load>,
    models: watch::Receiver<BTreeMap<String, ModelInfo>>,
}

/// What the thread is asked to do.
#[derive(Debug)]
pub(crate) enum Job {
    Plan(Waiting),
    Serve { model: Model, reply: oneshot::Sender<Result<(), Error>> },
    Unload { model: String, reply: oneshot::Sender<Result<(), Error>> },
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
        let (config, known) = (config.clone(), Arc::clone(&load));
        let capacity = config.queue_capacity.get();
        thread::Builder::new().name("model".into()).spawn(move || {
            tch::set_num_threads(threads.into());
            Owner::new(&config, models, published, known).run(&receiver);
        })?;
        let [places, searches] = [capacity, capacity.div_ceil(2)].map(|count| Arc::new(Semaphore::new(count.into())));
        Ok(Self { jobs: sender, places, capacity, searches, load, models: subscribed })
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
        let (place, estimate) = match self.admit(&task) {
            Ok(admitted) => admitted,
            Err(error) => return reply.send(Err(error)),
        };
        self.load.begin(estimate);
        let queued = debug_span!(parent: &task.span, "queue");
        let job = Job::Plan(Waiting { task, enqueued, queued, place, reply, estimate });
        if let Err(SendError(Job::Plan(Waiting { reply, .. }))) = self.jobs.send(job) {
            reply.send(Err(stopped()));
        }
    }

    /// A place in the queue, if the answer can come in time.
    fn admit(&self, task: &PlanTask) -> Result<(OwnedSemaphorePermit, Estimate), Error> {
        let estimate = self.load.estimate(task);
        let (places, count) = match estimate.long {
            true => (&self.searches, self.capacity.div_ceil(2)),
            false => (&self.places, self.capacity),
        };
        let place = Arc::clone(places).try_acquire_owned().map_err(|_| queue_full(count))?;
        if let Some(deadline) = task.deadline {
            if estimate.least > deadline && task.search.is_some() {
                return Err(too_long(deadline, estimate.least));
            }
            // What takes longer than ever just now may be let in, or else nobody would find out that it no longer does.
            let wait = self.load.wait(estimate);
            if wait > deadline && self.load.tasks() > 0 {
                return Err(too_many(deadline, wait));
            }
        }
        Ok((place, estimate))
    }

    /// Serves a model, in place of the one of its name, from the next plan on.
    ///
    /// # Errors
    /// If its name is new and one too many, or the thread has stopped.
    pub(crate) async fn serve(&self, model: Model) -> Result<(), Error> {
        let (reply, done) = oneshot::channel();
        self.jobs.send(Job::Serve { model, reply }).map_err(|_| stopped())?;
        done.await.map_err(|_| stopped())?
    }

    /// Serves a model no longer, with all its checkpoints.
    ///
    /// # Errors
    /// If there is none of that name, or the thread has stopped.
    pub(crate) async fn unload(&self, model: String) -> Result<(), Error> {
        let (reply, done) = oneshot::channel();
        self.jobs.send(Job::Unload { model, reply }).map_err(|_| stopped())?;
        done.await.map_err(|_| stopped())?
    }

    /// The models being served, by name.
    pub(crate) fn models(&self) -> watch::Ref<'_, BTreeMap<String, ModelInfo>> {
        self.models.borrow()
    }

    /// Ends the searches that go on, with an error.
    pub(crate) fn give_up(&self) {
        self.load.give_up();
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
