//! The caller's side of the one thread that owns every model. Plans wait for it in a bounded queue; a swap takes effect
//! between two plans.

use crate::config::Config;
use crate::load::{Estimate, Load};
use crate::model::Model;
use crate::outbox::{Outbox, PATIENCE};
use crate::owner::{Owner, Step};
use crate::task::{Answer, PlanTask, Reply, Waiting, queue_full, stopped, too_late, too_long, too_many};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, SendError};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use std::{fmt, io, thread};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot, watch};
use tokio_util::task::AbortOnDropHandle;
use tracing::{debug_span, warn};
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
    relay: Relay,
    outbox: Outbox,
    models: watch::Receiver<BTreeMap<String, ModelInfo>>,
}

/// State of the thread that owns the models.
struct Lead {
    owner: Owner,
    jobs: mpsc::Receiver<Job>,
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
    /// Starts the thread with these models, within a runtime of tokio.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub(crate) fn start(config: &Config, models: Vec<Model>) -> io::Result<Self> {
        let (sender, receiver) = mpsc::channel();
        let infos = models.iter().map(|model| (model.info.name.clone(), model.info.clone())).collect();
        let (published, subscribed) = watch::channel(infos);
        let load = Arc::new(Load::default());
        let owner = Owner::new(config, models, published, Arc::clone(&load));
        let capacity = config.queue_capacity.get();
        let [places, searches] = [capacity, capacity.div_ceil(2)].map(|count| Arc::new(Semaphore::new(count.into())));
        let relay = Relay {
            lead: Arc::new(Mutex::new(Some(Lead { owner, jobs: receiver }))),
            load: Arc::clone(&load),
            runtime: Handle::current(),
            is_watched: Arc::default(),
        };
        relay.spawn(|_| true)?;
        let outbox = Outbox::new(Handle::current());
        Ok(Self { jobs: sender, places, capacity, searches, load, relay, outbox, models: subscribed })
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

    /// Callback form of `plan`: `reply` is called once, by the model's thread or when the deadline passes. It may block.
    pub(crate) fn plan_then(&self, task: PlanTask, reply: impl FnOnce(Answer) + Send + 'static) {
        let outbox = self.outbox.clone();
        let Some(deadline) = task.deadline else {
            return self.enqueue(task, Reply::Called(Box::new(reply), outbox));
        };
        let pending = PendingReply(Arc::new(Mutex::new(Some(reply))));
        let (late, late_outbox) = (pending.clone(), outbox.clone());
        let clock = AbortOnDropHandle::new(self.relay.runtime.spawn(async move {
            tokio::time::sleep(deadline).await;
            late_outbox.put(move || late.send(Err(too_late(deadline))));
        }));
        let planned = move |answer| {
            pending.send(answer);
            drop(clock);
        };
        self.enqueue(task, Reply::Called(Box::new(planned), outbox));
    }

    /// Puts a task in the queue, or replies at once: if the queue is full, or so long that the deadline would pass, or the
    /// thread has stopped.
    fn enqueue(&self, task: PlanTask, reply: Reply) {
        let enqueued = Instant::now();
        let (place, estimate) = match self.admit(&task) {
            Ok(admitted) => admitted,
            Err(error) => return reply.send(Err(error)),
        };
        self.load.begin(estimate);
        let queued = debug_span!(parent: &task.span, "queue");
        let job = Job::Plan(Waiting { task, enqueued, queued, place, reply, estimate });
        if let Err(SendError(Job::Plan(Waiting { reply, .. }))) = self.jobs.send(job) {
            return reply.send(Err(stopped()));
        }
        if self.load.replying().is_some() {
            self.relay.watch();
        }
    }

    /// For what may block.
    pub(crate) fn outbox(&self) -> Outbox {
        self.outbox.clone()
    }

    /// Has a job done that is no plan.
    async fn ask(&self, job: Job, mut done: oneshot::Receiver<Result<(), Error>>) -> Result<(), Error> {
        self.jobs.send(job).map_err(|_| stopped())?;
        loop {
            let before = self.load.replying();
            match tokio::time::timeout(PATIENCE, &mut done).await {
                Ok(answer) => return answer.map_err(|_| stopped())?,
                Err(_) => before.into_iter().for_each(|reply| self.relay.take_over(reply)),
            }
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
        self.ask(Job::Serve { model, reply }, done).await
    }

    /// Serves a model no longer, with all its checkpoints.
    ///
    /// # Errors
    /// If there is none of that name, or the thread has stopped.
    pub(crate) async fn unload(&self, model: String) -> Result<(), Error> {
        let (reply, done) = oneshot::channel();
        self.ask(Job::Unload { model, reply }, done).await
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
            loop {
                let before = self.load.replying();
                match tokio::time::timeout(PATIENCE, models.changed()).await {
                    Ok(Ok(())) => {}
                    Ok(Err(_)) => return,
                    Err(_) => before.into_iter().for_each(|reply| self.relay.take_over(reply)),
                }
            }
        }
    }
}

/// A reply that two would give, the model's thread and the clock: the first does.
struct PendingReply<F>(Arc<Mutex<Option<F>>>);

impl<F: FnOnce(Answer)> PendingReply<F> {
    fn send(&self, answer: Answer) {
        let reply = self.0.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(reply) = reply {
            reply(answer);
        }
    }
}

impl<F> Clone for PendingReply<F> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl fmt::Debug for Lead {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Lead")
    }
}

/// The models, as they go from thread to thread.
#[derive(Debug, Clone)]
struct Relay {
    lead: Arc<Mutex<Option<Lead>>>,
    load: Arc<Load>,
    runtime: Handle,
    is_watched: Arc<AtomicBool>,
}

impl Relay {
    /// Starts a thread that owns the models, if `takes_over` says so there.
    fn spawn(&self, takes_over: impl FnOnce(&Load) -> bool + Send + 'static) -> io::Result<()> {
        let this = self.clone();
        thread::Builder::new().name("model".into()).spawn(move || {
            if takes_over(&this.load) {
                this.work();
            }
        })?;
        Ok(())
    }

    /// Owns the models until there is nothing more to do, or another thread has taken over. What may block is sent from here, without
    /// the models: another thread would have to be woken. If it does block, because its client does not read, another thread takes over
    /// the models and what is to be sent after it.
    fn work(&self) {
        let load = &*self.load;
        let lock = || self.lead.lock().unwrap_or_else(PoisonError::into_inner);
        let mut owned = lock();
        while let Some(Lead { owner, jobs }) = owned.as_mut() {
            match owner.step(jobs) {
                Step::Next => {}
                Step::End => *owned = None,
                Step::Reply(reply, answer) if load.has_stuck() => reply.send(answer),
                Step::Reply(reply, answer) => {
                    let number = load.begin_reply();
                    // Requests from now on see it, and have it watched.
                    if load.tasks() > 0 || owner.has_outgoing() {
                        self.watch();
                    }
                    drop(owned);
                    reply.send_here(answer);
                    if !load.end_reply(number) {
                        return;
                    }
                    owned = lock();
                }
            }
        }
    }

    /// Sees to it that nobody waits for an answer to another to be sent, as long as there is anything to be done.
    fn watch(&self) {
        if self.is_watched.swap(true, Ordering::SeqCst) {
            return;
        }
        let this = self.clone();
        self.runtime.spawn(async move {
            let mut before = None;
            loop {
                tokio::time::sleep(PATIENCE).await;
                let reply = this.load.replying();
                if let Some(reply) = reply.filter(|_| reply == before) {
                    this.take_over(reply);
                }
                before = reply;
                let nothing_to_watch = || this.load.tasks() == 0 && this.load.replying().is_none();
                if nothing_to_watch() {
                    this.is_watched.store(false, Ordering::SeqCst);
                    // Requests that came in the meantime are seen here, or see that nobody watches.
                    if nothing_to_watch() || this.is_watched.swap(true, Ordering::SeqCst) {
                        return;
                    }
                }
            }
        });
    }

    /// Lets another thread own the models, if this answer is still being sent.
    fn take_over(&self, reply: u64) {
        if self.load.replying() != Some(reply) {
            return;
        }
        if let Err(error) = self.spawn(move |load| load.take_over(reply)) {
            warn!(%error, "an answer is not read; those who wait do so until it is given up");
        }
    }
}
