//! Owner of all models, used by one thread at a time: runs jobs, and plans queued tasks in batches.

use crate::config::Config;
use crate::load::{Load, SLICE, resolve};
use crate::model::{Description, Model};
use crate::model_thread::Job;
use crate::searches::Searches;
use crate::served::Served;
use crate::task::{Accepted, Answer, GoalEmbedding, Latents, PlanTask, Reply, Waiting, deadline_exceeded};
use cpn::method::rollouts;
use lru::LruCache;
use metrics::{counter, histogram};
use std::any::Any;
use std::collections::{BTreeMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tracing::{debug_span, error};
use wire::planner::StageTimes;
use wire::{Code, Error};

/// Longest estimated time of a batch whose requests choose a search, so that other tasks do not wait long.
const MAX_BATCH_TIME: Duration = Duration::from_millis(30);

/// Owner of all models.
pub(crate) struct Owner {
    models: Served,
    /// Goal embeddings by goal and checkpoint, so that those of a swapped-out model are never used.
    embeddings: Embeddings,
    /// Jobs received from the channel and not done yet, in order.
    queue: VecDeque<Job>,
    searches: Searches,
    published: watch::Sender<BTreeMap<String, Description>>,
    load: Arc<Load>,
    batch_size: usize,
    batch_delay: Duration,
    /// Replies that may block their sender.
    outgoing: VecDeque<(Reply, Answer)>,
}

/// Outcome of a step: what the thread has to do next.
#[expect(
    clippy::large_enum_variant,
    reason = "it is taken apart where it is made, and a box would be allocated for each plan"
)]
pub(crate) enum Step {
    /// Run another step.
    Next,
    /// Send a reply without holding the models, then run another step.
    Reply(Reply, Answer),
    /// End the thread.
    End,
}

impl Owner {
    pub(crate) fn new(
        config: &Config,
        models: Vec<Model>,
        published: watch::Sender<BTreeMap<String, Description>>,
        load: Arc<Load>,
    ) -> Self {
        let mut served = Served::new(config.model_capacity.get().into(), config.retired_capacity.into());
        for model in models {
            load.register(&model.info.name, model.costs.clone());
            served.swap_in(model).expect("as many as fit");
        }
        Self {
            models: served,
            embeddings: LruCache::new(config.goal_capacity.into()),
            queue: VecDeque::new(),
            searches: Searches::default(),
            published,
            load,
            batch_size: config.batch_size.get().into(),
            batch_delay: Duration::from_millis(config.batch_delay_ms.into()),
            outgoing: VecDeque::new(),
        }
    }

    /// Runs the next job. Between jobs a sliced search advances, for as long as the job took, or for a full slice if there was
    /// none.
    pub(crate) fn step(&mut self, jobs: &mpsc::Receiver<Job>) -> Step {
        if let Some((reply, answer)) = self.outgoing.pop_front() {
            return Step::Reply(reply, answer);
        }

        let next = || if self.searches.is_empty() { jobs.recv().ok() } else { jobs.try_recv().ok() };
        let job = self.queue.pop_front().or_else(next);
        let (started, idle) = (Instant::now(), job.is_none());
        match job {
            Some(Job::Plan(first)) => {
                let batch = self.gather(*first, jobs);
                self.answer(batch);
            }
            Some(Job::Serve { model, reply }) => drop(reply.send(self.serve(model))),
            Some(Job::Unload { model, reply }) => drop(reply.send(self.unload(&model))),
            None if self.searches.is_empty() => return Step::End,
            Some(Job::Stop) => {
                while !self.searches.is_empty() {
                    self.advance(SLICE);
                }
                self.outgoing.drain(..).for_each(|(reply, answer)| reply.send(answer));
                return Step::End;
            }
            None => {}
        }

        if !self.searches.is_empty() {
            self.advance(if idle { SLICE } else { started.elapsed().min(SLICE) });
        }
        Step::Next
    }

    /// Whether replies wait to be sent.
    pub(crate) fn has_outgoing(&self) -> bool {
        !self.outgoing.is_empty()
    }

    fn serve(&mut self, model: Model) -> Result<(), Error> {
        let (description, costs) = (model.describe(), model.costs.clone());
        let name = description.info.name.clone();
        self.models.swap_in(model)?;
        self.load.register(&name, costs);
        self.published.send_modify(|models| drop(models.insert(name, description)));
        Ok(())
    }

    fn unload(&mut self, model: &str) -> Result<(), Error> {
        self.models.remove(model)?;
        self.load.forget(model);
        self.published.send_modify(|models| drop(models.remove(model)));
        Ok(())
    }

    fn advance(&mut self, share: Duration) {
        for (accepted, answer) in self.searches.advance(&self.load, share) {
            self.reply(accepted, answer);
        }
    }

    /// Batch of a task: it and the compatible queued tasks, up to the next swap, as long as no deadline of the batch is missed.
    fn gather(&mut self, first: Waiting, jobs: &mpsc::Receiver<Job>) -> Vec<Waiting> {
        // Sampling searches use all threads already, and an anytime search ends as soon as other tasks wait.
        let alone = first.task.is_anytime() || first.task.is_sampled();
        let most = if alone { 1 } else { self.batch_size.min(self.batch_limit(&first)) };
        self.fill_queue(&first.task, most, jobs);

        let swap = self.queue.iter().position(|job| !matches!(job, Job::Plan(_))).unwrap_or(self.queue.len());
        let after = self.queue.split_off(swap);
        let mut due = first.due();
        let mut time = Load::bound(first.estimate);
        let (mut batch, mut rest) = (vec![first], VecDeque::new());
        for job in self.queue.drain(..) {
            match job {
                Job::Plan(waiting) if batch.len() < most && waiting.task.is_compatible(&batch[0].task) => {
                    let earliest = due.into_iter().chain(waiting.due()).min();
                    let together = time + Load::bound(waiting.estimate);
                    let in_time = earliest.is_none_or(|due| Instant::now() + together <= due);
                    let short = waiting.estimate.is_long || waiting.task.search.is_none() || together <= MAX_BATCH_TIME;
                    if in_time && short {
                        (due, time) = (earliest, together);
                        batch.push(*waiting);
                    } else {
                        rest.push_back(Job::Plan(waiting));
                    }
                }
                other => rest.push_back(other),
            }
        }

        rest.extend(after);
        self.queue = rest;
        batch
    }

    /// Largest batch of tasks like this one.
    fn batch_limit(&mut self, first: &Waiting) -> usize {
        let PlanTask { model, model_digest, .. } = &first.task;
        match self.models.get(model, model_digest.as_deref()) {
            Ok(model) if first.estimate.is_long => model.model().method.together(),
            _ => usize::MAX,
        }
    }

    /// Moves received jobs to the queue and waits, within the batching delay, for a full batch.
    fn fill_queue(&mut self, first: &PlanTask, most: usize, jobs: &mpsc::Receiver<Job>) {
        let until = Instant::now() + self.batch_delay;
        self.queue.extend(jobs.try_iter());
        let is_compatible = |job: &&Job| matches!(job, Job::Plan(waiting) if waiting.task.is_compatible(first));
        while self.queue.iter().filter(is_compatible).count() + 1 < most {
            match jobs.recv_timeout(until.saturating_duration_since(Instant::now())) {
                Ok(job) => self.queue.push_back(job),
                Err(_) => return,
            }
        }
    }

    /// Answers a batch. A panic in one task ends neither the thread nor the plans of the others. A sliced search is only begun.
    fn answer(&mut self, batch: Vec<Waiting>) {
        let started = Instant::now();
        let mut accepted = Vec::with_capacity(batch.len());
        for Waiting { task, enqueued, queued, place, reply, estimate } in batch {
            drop(queued);
            let _place = estimate.is_long.then_some(place);
            let late = task.deadline.filter(|deadline| started - enqueued >= *deadline);
            let checked = late.map_or_else(|| self.check(&task), |deadline| Err(deadline_exceeded(deadline)));
            let task = Accepted { task, enqueued, reply, estimate, _place };
            match checked {
                _ if task.reply.is_cancelled() => self.load.end(estimate),
                Ok(()) => accepted.push(task),
                Err(error) => self.reply(task, Err(error)),
            }
        }

        let Some(first) = accepted.first() else { return };
        histogram!("cpn_planner_batch_size").record(accepted.len() as f64);
        if first.estimate.is_long {
            return self.begin(accepted);
        }

        let tasks: Vec<_> = accepted.iter().map(|accepted| &accepted.task).collect();
        let mut plans = self.catching_panics(&tasks, |owner| owner.plan(&tasks));
        if tasks.len() > 1 && plans.iter().any(Result::is_err) {
            // Planned one by one, so that only the faulty task fails.
            plans = tasks.iter().flat_map(|task| self.catching_panics(&[task], |owner| owner.plan(&[task]))).collect();
        }
        for (accepted, mut plan) in accepted.into_iter().zip(plans) {
            if let Ok(response) = &mut plan {
                response.times.queue_seconds = (started - accepted.enqueued).as_secs_f64();
            }
            self.reply(accepted, plan);
        }
    }

    fn reply(&mut self, Accepted { reply, estimate, .. }: Accepted, answer: Answer) {
        self.load.end(estimate);
        if let Ok(response) = &answer {
            observe(response.times);
        }
        if reply.may_block() && !self.load.has_blocked_reply() {
            self.outgoing.push_back((reply, answer));
        } else {
            reply.send(answer);
        }
    }

    fn check(&mut self, task: &PlanTask) -> Result<(), Error> {
        self.models.get(&task.model, task.model_digest.as_deref())?.model().check(task)
    }

    /// Runs a closure that answers these tasks; a panic becomes the error of each.
    fn catching_panics(&mut self, tasks: &[&PlanTask], run: impl FnOnce(&mut Self) -> Vec<Answer>) -> Vec<Answer> {
        catch_unwind(AssertUnwindSafe(|| run(self)))
            .unwrap_or_else(|panic| vec![Err(panicked(tasks[0], &*panic)); tasks.len()])
    }

    /// Plans a batch of checked tasks.
    fn plan(&mut self, tasks: &[&PlanTask]) -> Vec<Answer> {
        let Self { models, embeddings, load, .. } = self;
        let PlanTask { model: name, model_digest, search, .. } = tasks[0];
        let shared = models.get(name, model_digest.as_deref()).expect("checked");
        let mut model = shared.model();
        let started = Instant::now();
        let latents = encode(&mut model, embeddings, tasks);
        let encoded = started.elapsed();

        let queries: Vec<_> = tasks.iter().zip(&latents).map(|(task, latents)| task.query(latents)).collect();
        let spans: Vec<_> = tasks.iter().map(|task| debug_span!(parent: &task.span, "search")).collect();
        let plans = model.plan(&queries, *search);
        drop(spans);
        let planned = started.elapsed() - encoded;

        load.measure(name, |costs| {
            costs.record_embedding(tasks.len(), encoded);
            let (solver, iterations) = resolve(*search, model.method.updates().unwrap_or_default());
            costs.record_rollouts(solver, tasks.len() * rollouts(solver, iterations), planned);
        });
        let times = StageTimes {
            queue_seconds: 0.0,
            encode_seconds: encoded.as_secs_f64(),
            plan_seconds: planned.as_secs_f64(),
        };
        let planned = tasks.iter().zip(plans).zip(&latents);
        planned.map(|((task, plan), latents)| model.response(task, plan, latents, times)).collect()
    }

    /// Begins a sliced search for a batch of checked tasks.
    fn begin(&mut self, accepted: Vec<Accepted>) {
        let started = Instant::now();
        let Self { models, embeddings, .. } = self;
        let tasks: Vec<_> = accepted.iter().map(|accepted| &accepted.task).collect();
        let PlanTask { model: name, model_digest, .. } = tasks[0];
        let model = models.get(name, model_digest.as_deref()).expect("checked");
        let latents = catch_unwind(AssertUnwindSafe(|| encode(&mut model.model(), embeddings, &tasks)));
        let encoded = started.elapsed();
        match latents {
            Ok(latents) => {
                self.load.measure(name, |costs| costs.record_embedding(tasks.len(), encoded));
                self.searches.begin(&model, accepted, latents, encoded);
            }
            Err(panic) => {
                let error = panicked(tasks[0], &*panic);
                accepted.into_iter().for_each(|accepted| self.reply(accepted, Err(error.clone())));
            }
        }
    }
}

/// LRU cache of goal embeddings, by goal id and checkpoint digest.
type Embeddings = LruCache<(String, String), GoalEmbedding>;

/// Embeds all observations, and the goals that are not cached.
fn encode(model: &mut Model, embeddings: &mut Embeddings, tasks: &[&PlanTask]) -> Vec<Latents> {
    let _spans: Vec<_> = tasks.iter().map(|task| debug_span!(parent: &task.span, "encode")).collect();
    let key = |task: &PlanTask| (task.goal_id.clone(), model.info.digest.clone());
    let known: Vec<_> = tasks.iter().map(|task| embeddings.get(&key(task)).cloned()).collect();
    let unknown = tasks.iter().zip(&known).filter(|(_, known)| known.is_none()).map(|(task, _)| &*task.goal);
    let keys: Vec<_> = tasks.iter().map(|task| key(task)).collect();
    let inputs: Vec<_> = tasks.iter().map(|task| &task.observation).chain(unknown).collect();
    let mut xs = model.encode(&inputs);
    let new = xs.split_off(tasks.len()).into_iter();
    let mut new = new.map(|x_g| GoalEmbedding { is_familiar: model.method.is_familiar(&x_g), x_g });
    let goals: Vec<_> = known.into_iter().map(|known| known.or_else(|| new.next()).unwrap_or_default()).collect();
    keys.into_iter().zip(&goals).for_each(|(key, goal)| drop(embeddings.put(key, goal.clone())));

    let moves_positions = model.method.moves_positions();
    let embedded = tasks.iter().zip(xs).zip(goals);
    embedded.map(|((task, x), goal)| Latents::new(task, x, goal, moves_positions)).collect()
}

/// Records metrics of an answer: the count, and the time of each stage.
fn observe(times: StageTimes) {
    counter!("cpn_planner_plans_total").increment(1);
    for (stage, seconds) in
        [("queue", times.queue_seconds), ("encode", times.encode_seconds), ("plan", times.plan_seconds)]
    {
        histogram!("cpn_planner_stage_seconds", "stage" => stage).record(seconds);
    }
}

/// Error of a task whose planning panicked.
pub(crate) fn panicked(task: &PlanTask, panic: &(dyn Any + Send)) -> Error {
    let reason = panic_message(panic);
    error!(model = task.model, reason, "planning panicked");
    Error::new(Code::Internal, "plan", "a plan", reason)
}

/// Message of a panic; `tch` panics with that of libtorch.
fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic")
}
