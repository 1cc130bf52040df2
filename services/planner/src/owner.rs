//! What one thread at a time owns: every model. What waits is planned together, as far as it can be.

use crate::config::Config;
use crate::load::{Load, SLICE, resolve};
use crate::model::Model;
use crate::model_thread::Job;
use crate::searches::Searches;
use crate::served::Served;
use crate::task::{Accepted, Answer, PlanTask, Reply, Waiting, too_late};
use cpn::method::{Query, rollouts};
use lru::LruCache;
use metrics::{counter, histogram};
use std::any::Any;
use std::collections::{BTreeMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tracing::{debug_span, error};
use wire::planner::{ModelInfo, StageTimes};
use wire::{Code, Error};

/// What plans that a request's search makes longer may take together, so that others need not wait for long.
const BATCH: Duration = Duration::from_millis(30);

/// The thread's side.
pub(crate) struct Owner {
    models: Served,
    /// Goal embeddings by goal and checkpoint, so that those of a swapped-out model are never used.
    embeddings: Embeddings,
    /// Jobs that were taken from the channel and are not done yet, in order.
    queue: VecDeque<Job>,
    searches: Searches,
    published: watch::Sender<BTreeMap<String, ModelInfo>>,
    load: Arc<Load>,
    batch_size: usize,
    batch_delay: Duration,
    /// Answers that may block whoever sends them.
    outgoing: VecDeque<(Reply, Answer)>,
}

/// Next thing to do.
#[expect(
    clippy::large_enum_variant,
    reason = "it is taken apart where it is made, and a box would be allocated for each plan"
)]
pub(crate) enum Step {
    /// Another step.
    Next,
    /// To answer, without the models, and then another step.
    Reply(Reply, Answer),
    /// Nothing, ever.
    End,
}

impl Owner {
    pub(crate) fn new(
        config: &Config,
        models: Vec<Model>,
        published: watch::Sender<BTreeMap<String, ModelInfo>>,
        load: Arc<Load>,
    ) -> Self {
        let mut served = Served::new(config.model_capacity.get().into(), config.retired_capacity.into());
        for model in models {
            load.learn(&model.info.name, model.costs.clone());
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

    /// Does the next job. A search that takes long is gone on with between other jobs, for as long as these take, or while there
    /// are none.
    pub(crate) fn step(&mut self, jobs: &mpsc::Receiver<Job>) -> Step {
        if let Some((reply, answer)) = self.outgoing.pop_front() {
            return Step::Reply(reply, answer);
        }
        let next = || if self.searches.is_empty() { jobs.recv().ok() } else { jobs.try_recv().ok() };
        let job = self.queue.pop_front().or_else(next);
        let (started, idle) = (Instant::now(), job.is_none());
        match job {
            Some(Job::Plan(first)) => {
                let batch = self.gather(first, jobs);
                self.answer(batch);
            }
            Some(Job::Serve { model, reply }) => drop(reply.send(self.serve(model))),
            Some(Job::Unload { model, reply }) => drop(reply.send(self.unload(&model))),
            None if self.searches.is_empty() => return Step::End,
            Some(Job::Stop) => {
                while !self.searches.is_empty() {
                    self.go_on(SLICE);
                }
                self.outgoing.drain(..).for_each(|(reply, answer)| reply.send(answer));
                return Step::End;
            }
            None => {}
        }
        if !self.searches.is_empty() {
            self.go_on(if idle { SLICE } else { started.elapsed().min(SLICE) });
        }
        Step::Next
    }

    /// Whether there is more to be sent.
    pub(crate) fn has_outgoing(&self) -> bool {
        !self.outgoing.is_empty()
    }

    fn serve(&mut self, model: Model) -> Result<(), Error> {
        let (info, costs) = (model.info.clone(), model.costs.clone());
        self.models.swap_in(model)?;
        self.load.learn(&info.name, costs);
        self.published.send_modify(|infos| drop(infos.insert(info.name.clone(), info)));
        Ok(())
    }

    fn unload(&mut self, model: &str) -> Result<(), Error> {
        self.models.remove(model)?;
        self.load.forget(model);
        self.published.send_modify(|infos| drop(infos.remove(model)));
        Ok(())
    }

    fn go_on(&mut self, share: Duration) {
        for (accepted, answer) in self.searches.go_on(&self.load, share) {
            self.reply(accepted, answer);
        }
    }

    /// What can be planned with the first: the tasks like it that wait, up to the next swap, as long as none would be late for
    /// the others' sake.
    fn gather(&mut self, first: Waiting, jobs: &mpsc::Receiver<Job>) -> Vec<Waiting> {
        // Plans are tried on all threads, and a search that is over when others wait has nobody beside it.
        let alone = first.task.is_anytime() || first.task.is_sampled();
        let most = if alone { 1 } else { self.batch_size.min(self.together(&first)) };
        self.listen(&first.task, most, jobs);
        let swap = self.queue.iter().position(|job| !matches!(job, Job::Plan(_))).unwrap_or(self.queue.len());
        let after = self.queue.split_off(swap);
        let mut due = first.due();
        let mut time = Load::time(first.estimate);
        let (mut batch, mut rest) = (vec![first], VecDeque::new());
        for job in self.queue.drain(..) {
            match job {
                Job::Plan(waiting) if batch.len() < most && waiting.task.is_like(&batch[0].task) => {
                    let earliest = due.into_iter().chain(waiting.due()).min();
                    let together = time + Load::time(waiting.estimate);
                    let in_time = earliest.is_none_or(|due| Instant::now() + together <= due);
                    let short = waiting.estimate.long || waiting.task.search.is_none() || together <= BATCH;
                    if in_time && short {
                        (due, time) = (earliest, together);
                        batch.push(waiting);
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

    /// How many tasks like this one can be planned for together.
    fn together(&mut self, first: &Waiting) -> usize {
        let PlanTask { model, model_digest, .. } = &first.task;
        match self.models.get(model, model_digest.as_deref()) {
            Ok(model) if first.estimate.long => model.model().method.together(),
            _ => usize::MAX,
        }
    }

    /// Takes all that has come into the queue and, if the delay allows, waits for what makes the batch full.
    fn listen(&mut self, first: &PlanTask, most: usize, jobs: &mpsc::Receiver<Job>) {
        let until = Instant::now() + self.batch_delay;
        self.queue.extend(jobs.try_iter());
        let is_like_first = |job: &&Job| matches!(job, Job::Plan(waiting) if waiting.task.is_like(first));
        while self.queue.iter().filter(is_like_first).count() + 1 < most {
            match jobs.recv_timeout(until.saturating_duration_since(Instant::now())) {
                Ok(job) => self.queue.push_back(job),
                Err(_) => return,
            }
        }
    }

    /// Answers tasks of one kind, whatever happens: a fault of one ends neither the thread nor the others' plans. Those that take
    /// long are begun only.
    fn answer(&mut self, batch: Vec<Waiting>) {
        let started = Instant::now();
        let mut accepted = Vec::with_capacity(batch.len());
        for Waiting { task, enqueued, queued, place, reply, estimate } in batch {
            drop(queued);
            let _place = estimate.long.then_some(place);
            // A client that gave up has closed its end.
            let late = task.deadline.filter(|deadline| started - enqueued >= *deadline);
            let checked = late.map_or_else(|| self.check(&task), |deadline| Err(too_late(deadline)));
            let task = Accepted { task, enqueued, reply, estimate, _place };
            match checked {
                _ if task.reply.is_given_up() => self.load.end(estimate),
                Ok(()) => accepted.push(task),
                Err(error) => self.reply(task, Err(error)),
            }
        }
        let Some(first) = accepted.first() else { return };
        histogram!("cpn_planner_batch_size").record(accepted.len() as f64);
        if first.estimate.long {
            return self.begin(accepted);
        }

        let tasks: Vec<_> = accepted.iter().map(|accepted| &accepted.task).collect();
        let mut plans = self.guarded(&tasks, |owner| owner.plan(&tasks));
        if tasks.len() > 1 && plans.iter().any(Result::is_err) {
            // Which of them was at fault shows when each is alone.
            plans = tasks.iter().flat_map(|task| self.guarded(&[task], |owner| owner.plan(&[task]))).collect();
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
        if reply.may_block() && !self.load.has_stuck() {
            self.outgoing.push_back((reply, answer));
        } else {
            reply.send(answer);
        }
    }

    fn check(&mut self, task: &PlanTask) -> Result<(), Error> {
        self.models.get(&task.model, task.model_digest.as_deref())?.model().check(task)
    }

    /// Runs what answers tasks, one by one; a panic is everybody's error.
    fn guarded(&mut self, tasks: &[&PlanTask], run: impl FnOnce(&mut Self) -> Vec<Answer>) -> Vec<Answer> {
        catch_unwind(AssertUnwindSafe(|| run(self)))
            .unwrap_or_else(|panic| vec![Err(panicked(tasks[0], &*panic)); tasks.len()])
    }

    /// Plans for tasks of one kind that were checked.
    fn plan(&mut self, tasks: &[&PlanTask]) -> Vec<Answer> {
        let Self { models, embeddings, load, .. } = self;
        let PlanTask { model: name, model_digest, search, .. } = tasks[0];
        let shared = models.get(name, model_digest.as_deref()).expect("checked");
        let mut model = shared.model();
        let started = Instant::now();
        let ends = encode(&mut model, embeddings, tasks);
        let encoded = started.elapsed();
        let queries = tasks.iter().zip(&ends);
        let queries = queries.map(|(task, (x, x_g))| Query { x, x_g, seed: task.seed, start: &task.warm_start });
        let queries: Vec<_> = queries.collect();
        let spans: Vec<_> = tasks.iter().map(|task| debug_span!(parent: &task.span, "search")).collect();
        let plans = model.plan(&queries, *search);
        drop(spans);
        let planned = started.elapsed() - encoded;
        load.measure(name, |costs| {
            costs.embedded(tasks.len(), encoded);
            let (solver, iterations) = resolve(*search, model.method.updates().unwrap_or_default());
            costs.rolled_out(solver, tasks.len() * rollouts(solver, iterations), planned);
        });
        let times = StageTimes {
            queue_seconds: 0.0,
            encode_seconds: encoded.as_secs_f64(),
            plan_seconds: planned.as_secs_f64(),
        };
        let planned = tasks.iter().zip(plans).zip(&queries);
        planned.map(|((task, plan), query)| model.response(task, plan, query, times)).collect()
    }

    /// Begins a search for tasks of one kind that were checked.
    fn begin(&mut self, accepted: Vec<Accepted>) {
        let started = Instant::now();
        let Self { models, embeddings, .. } = self;
        let tasks: Vec<_> = accepted.iter().map(|accepted| &accepted.task).collect();
        let PlanTask { model: name, model_digest, .. } = tasks[0];
        let model = models.get(name, model_digest.as_deref()).expect("checked");
        let ends = catch_unwind(AssertUnwindSafe(|| encode(&mut model.model(), embeddings, &tasks)));
        let encoded = started.elapsed();
        match ends {
            Ok(ends) => {
                self.load.measure(name, |costs| costs.embedded(tasks.len(), encoded));
                self.searches.begin(&model, accepted, ends, encoded);
            }
            Err(panic) => {
                let error = panicked(tasks[0], &*panic);
                accepted.into_iter().for_each(|accepted| self.reply(accepted, Err(error.clone())));
            }
        }
    }
}

/// Embeddings by what was embedded and the checkpoint that did.
type Embeddings = LruCache<(String, String), Vec<f32>>;

/// Embeds every observation, and the goals that are not known yet: x and x_g of each task.
fn encode(model: &mut Model, embeddings: &mut Embeddings, tasks: &[&PlanTask]) -> Vec<(Vec<f32>, Vec<f32>)> {
    let _spans: Vec<_> = tasks.iter().map(|task| debug_span!(parent: &task.span, "encode")).collect();
    let key = |task: &PlanTask| (task.goal_id.clone(), model.info.digest.clone());
    let known: Vec<_> = tasks.iter().map(|task| embeddings.get(&key(task)).cloned()).collect();
    let unknown = tasks.iter().zip(&known).filter(|(_, known)| known.is_none()).map(|(task, _)| &*task.goal);
    let keys: Vec<_> = tasks.iter().map(|task| key(task)).collect();
    let inputs: Vec<_> = tasks.iter().map(|task| &task.observation).chain(unknown).collect();
    let mut xs = model.encode(&inputs);
    let mut new = xs.split_off(tasks.len()).into_iter();
    let x_gs: Vec<_> = known.into_iter().map(|known| known.or_else(|| new.next()).unwrap_or_default()).collect();
    keys.into_iter().zip(&x_gs).for_each(|(key, x_g)| drop(embeddings.put(key, x_g.clone())));
    xs.into_iter().zip(x_gs).collect()
}

/// Counts an answer, and where its time went.
fn observe(times: StageTimes) {
    counter!("cpn_planner_plans_total").increment(1);
    for (stage, seconds) in
        [("queue", times.queue_seconds), ("encode", times.encode_seconds), ("plan", times.plan_seconds)]
    {
        histogram!("cpn_planner_stage_seconds", "stage" => stage).record(seconds);
    }
}

/// The error of a task whose planning panicked.
pub(crate) fn panicked(task: &PlanTask, panic: &(dyn Any + Send)) -> Error {
    let reason = panic_message(panic);
    error!(model = task.model, reason, "planning panicked");
    Error::new(Code::Internal, "plan", "a plan", reason)
}

/// What a panic says; `tch` panics with the message of libtorch.
fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic")
}
