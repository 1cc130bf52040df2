//! Handle of the model thread, which owns all models. Plans wait in its bounded queue; a swap takes effect between two plans.

use crate::config::Config;
use crate::load::{Estimate, Load};
use crate::model::{Description, Model};
use crate::outbox::{Outbox, STALL_TIMEOUT};
use crate::owner::{Owner, Step};
use crate::task::{
    Answer, PlanTask, Reply, Waiting, deadline_exceeded, queue_full, search_too_long, shutting_down, wait_too_long,
};
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

/// Handle of the model thread.
#[derive(Debug, Clone)]
pub(crate) struct ModelThread {
    /// Unbounded FIFO queue: `places` bounds the queued plans, so that a swap is never refused.
    jobs: mpsc::Sender<Job>,
    places: Arc<Semaphore>,
    capacity: u16,
    /// Places of sliced searches, held until they are answered: half as many.
    searches: Arc<Semaphore>,
    load: Arc<Load>,
    leadership: Leadership,
    outbox: Outbox,
    models: watch::Receiver<BTreeMap<String, Description>>,
}

/// State of the leader, the thread that owns the models.
struct Leader {
    owner: Owner,
    jobs: mpsc::Receiver<Job>,
}

/// Job of the model thread.
#[derive(Debug)]
pub(crate) enum Job {
    Plan(Box<Waiting>),
    Serve { model: Model, reply: oneshot::Sender<Result<(), Error>> },
    Unload { model: String, reply: oneshot::Sender<Result<(), Error>> },
    Stop,
}

impl ModelThread {
    /// Starts the thread with these models; requires a tokio runtime.
    ///
    /// # Errors
    /// If the thread cannot be started.
    pub(crate) fn start(config: &Config, models: Vec<Model>) -> io::Result<Self> {
        let (sender, receiver) = mpsc::channel();
        let descriptions = models.iter().map(|model| (model.info.name.clone(), model.describe())).collect();
        let (published, subscribed) = watch::channel(descriptions);
        let load = Arc::new(Load::default());
        let owner = Owner::new(config, models, published, Arc::clone(&load));

        let capacity = config.queue_capacity.get();
        let [places, searches] = [capacity, capacity.div_ceil(2)].map(|count| Arc::new(Semaphore::new(count.into())));
        let leadership = Leadership {
            leader: Arc::new(Mutex::new(Some(Leader { owner, jobs: receiver }))),
            load: Arc::clone(&load),
            runtime: Handle::current(),
            is_watched: Arc::default(),
        };
        leadership.spawn(|_| true)?;
        let outbox = Outbox::new(Handle::current());
        Ok(Self { jobs: sender, places, capacity, searches, load, leadership, outbox, models: subscribed })
    }

    /// Queues a task and awaits its plan.
    ///
    /// # Errors
    /// If the queue is full, the expected wait exceeds the deadline, the deadline passes, the thread has stopped, or planning
    /// fails.
    pub(crate) async fn plan(&self, task: PlanTask) -> Answer {
        let due = task.deadline.map(|deadline| (Instant::now() + deadline, deadline));
        let (reply, answer) = oneshot::channel();
        self.enqueue(task, Reply::Channel(reply));
        let answer = match due {
            Some((due, deadline)) => {
                tokio::time::timeout_at(due.into(), answer).await.map_err(|_| deadline_exceeded(deadline))?
            }
            None => answer.await,
        };
        answer.map_err(|_| shutting_down())?
    }

    /// Callback form of `plan`: `reply` is called once, by the model thread or when the deadline passes. It may block.
    pub(crate) fn plan_then(&self, task: PlanTask, reply: impl FnOnce(Answer) + Send + 'static) {
        let outbox = self.outbox.clone();
        let Some(deadline) = task.deadline else {
            return self.enqueue(task, Reply::Callback(Box::new(reply), outbox));
        };

        let pending = PendingReply(Arc::new(Mutex::new(Some(reply))));
        let (late, late_outbox) = (pending.clone(), outbox.clone());
        let timer = AbortOnDropHandle::new(self.leadership.runtime.spawn(async move {
            tokio::time::sleep(deadline).await;
            late_outbox.put(move || late.send(Err(deadline_exceeded(deadline))));
        }));
        let planned = move |answer| {
            pending.send(answer);
            drop(timer);
        };
        self.enqueue(task, Reply::Callback(Box::new(planned), outbox));
    }

    /// Queues a task, or replies at once with an error: if the queue is full, the expected wait exceeds the deadline, or the
    /// thread has stopped.
    fn enqueue(&self, task: PlanTask, reply: Reply) {
        let enqueued = Instant::now();
        let (place, estimate) = match self.admit(&task) {
            Ok(admitted) => admitted,
            Err(error) => return reply.send(Err(error)),
        };
        self.load.begin(estimate);
        let queued = debug_span!(parent: &task.span, "queue");
        let job = Job::Plan(Box::new(Waiting { task, enqueued, queued, place, reply, estimate }));
        if let Err(SendError(Job::Plan(waiting))) = self.jobs.send(job) {
            return waiting.reply.send(Err(shutting_down()));
        }
        if self.load.replying().is_some() {
            self.leadership.watch();
        }
    }

    /// Outbox for replies that may block.
    pub(crate) fn outbox(&self) -> Outbox {
        self.outbox.clone()
    }

    /// Runs a job that is no plan, and takes the models over from a thread that is blocked in a reply.
    async fn run(&self, job: Job, mut done: oneshot::Receiver<Result<(), Error>>) -> Result<(), Error> {
        self.jobs.send(job).map_err(|_| shutting_down())?;
        loop {
            let before = self.load.replying();
            match tokio::time::timeout(STALL_TIMEOUT, &mut done).await {
                Ok(answer) => return answer.map_err(|_| shutting_down())?,
                Err(_) => before.into_iter().for_each(|reply| self.leadership.take_over(reply)),
            }
        }
    }

    /// Admits a task: a place in the queue, if the answer is expected in time.
    fn admit(&self, task: &PlanTask) -> Result<(OwnedSemaphorePermit, Estimate), Error> {
        let estimate = self.load.estimate(task);
        let (places, count) = match estimate.is_long {
            true => (&self.searches, self.capacity.div_ceil(2)),
            false => (&self.places, self.capacity),
        };
        let place = Arc::clone(places).try_acquire_owned().map_err(|_| queue_full(count))?;
        if let Some(deadline) = task.deadline {
            if estimate.minimum > deadline && task.search.is_some() {
                return Err(search_too_long(deadline, estimate.minimum));
            }
            // An empty queue admits any task: after one slow measurement, no other would be taken otherwise.
            let wait = self.load.wait(estimate);
            if wait > deadline && self.load.tasks() > 0 {
                return Err(wait_too_long(deadline, wait));
            }
        }
        Ok((place, estimate))
    }

    /// Serves a model, in place of the one of its name, from the next plan on.
    ///
    /// # Errors
    /// If its name is new and beyond the model capacity, or the thread has stopped.
    pub(crate) async fn serve(&self, model: Model) -> Result<(), Error> {
        let (reply, done) = oneshot::channel();
        self.run(Job::Serve { model, reply }, done).await
    }

    /// Stops serving a model and all its checkpoints.
    ///
    /// # Errors
    /// If no model has the name, or the thread has stopped.
    pub(crate) async fn unload(&self, model: String) -> Result<(), Error> {
        let (reply, done) = oneshot::channel();
        self.run(Job::Unload { model, reply }, done).await
    }

    /// Served models, by name.
    pub(crate) fn models(&self) -> watch::Ref<'_, BTreeMap<String, Description>> {
        self.models.borrow()
    }

    /// Ends searches in progress, with an error.
    pub(crate) fn abort_searches(&self) {
        self.load.abort();
    }

    /// Finishes the queued jobs and ends the thread; later requests are refused.
    pub(crate) async fn stop(&self) {
        // The thread has ended once its end of the channel is closed, possibly before this call.
        let mut models = self.models.clone();
        if self.jobs.send(Job::Stop).is_ok() {
            loop {
                let before = self.load.replying();
                match tokio::time::timeout(STALL_TIMEOUT, models.changed()).await {
                    Ok(Ok(())) => {}
                    Ok(Err(_)) => return,
                    Err(_) => before.into_iter().for_each(|reply| self.leadership.take_over(reply)),
                }
            }
        }
    }
}

/// Reply shared by the model thread and the deadline's timer; the first to send wins.
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

impl fmt::Debug for Leader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Leader")
    }
}

/// Hand-over of the models between threads, as in the leader/followers pattern.
#[derive(Debug, Clone)]
struct Leadership {
    leader: Arc<Mutex<Option<Leader>>>,
    load: Arc<Load>,
    runtime: Handle,
    is_watched: Arc<AtomicBool>,
}

impl Leadership {
    /// Starts a thread that leads if `takes_over`, evaluated on that thread, is true.
    fn spawn(&self, takes_over: impl FnOnce(&Load) -> bool + Send + 'static) -> io::Result<()> {
        let this = self.clone();
        thread::Builder::new().name("model".into()).spawn(move || {
            if takes_over(&this.load) {
                this.lead();
            }
        })?;
        Ok(())
    }

    /// Owns the models until the planner stops or another thread takes over. Replies that may block are sent from this thread,
    /// without holding the models, since waking another thread costs latency. If a reply does block, because its client does
    /// not read, another thread takes over the models and the remaining replies.
    fn lead(&self) {
        let load = &*self.load;
        let lock = || self.leader.lock().unwrap_or_else(PoisonError::into_inner);

        let mut owned = lock();
        while let Some(Leader { owner, jobs }) = owned.as_mut() {
            match owner.step(jobs) {
                Step::Next => {}
                Step::End => *owned = None,
                Step::Reply(reply, answer) if load.has_blocked_reply() => reply.send(answer),
                Step::Reply(reply, answer) => {
                    let number = load.begin_reply();
                    // Requests enqueued from now on see the reply, and start the watchdog themselves.
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

    /// Starts the watchdog, unless it runs: while there are tasks, it takes the models over from a thread that is blocked in a
    /// reply.
    fn watch(&self) {
        if self.is_watched.swap(true, Ordering::SeqCst) {
            return;
        }
        let this = self.clone();
        self.runtime.spawn(async move {
            let mut before = None;
            loop {
                tokio::time::sleep(STALL_TIMEOUT).await;
                let reply = this.load.replying();
                if let Some(reply) = reply.filter(|_| reply == before) {
                    this.take_over(reply);
                }
                before = reply;

                let nothing_to_watch = || this.load.tasks() == 0 && this.load.replying().is_none();
                if nothing_to_watch() {
                    this.is_watched.store(false, Ordering::SeqCst);
                    // A request that came in the meantime is seen here, or sees that there is no watchdog.
                    if nothing_to_watch() || this.is_watched.swap(true, Ordering::SeqCst) {
                        return;
                    }
                }
            }
        });
    }

    /// Starts a thread that takes over the models, if this reply is still being sent.
    fn take_over(&self, reply: u64) {
        if self.load.replying() != Some(reply) {
            return;
        }
        if let Err(error) = self.spawn(move |load| load.take_over(reply)) {
            warn!(%error, "an answer is not read; those who wait do so until it is given up");
        }
    }
}
