//! The one thread that owns every model. What waits is planned together, as far as it can be.

use crate::config::Config;
use crate::load::Load;
use crate::model::{Model, Planned};
use crate::model_thread::Job;
use crate::served::Served;
use crate::task::{Answer, PlanTask, Reply, Waiting, too_late};
use cpn::method::Query;
use lru::LruCache;
use metrics::{counter, histogram};
use std::any::Any;
use std::collections::{BTreeMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tracing::{debug_span, error};
use wire::planner::{ModelInfo, PlanResponse, StageTimes};
use wire::{Code, Error};

/// Most iterations of a search that goes on until its deadline.
const MOST_ITERATIONS: usize = 1000;
/// The part of a deadline that such a search may use; the answer must still be sent.
const USABLE: f64 = 0.9;

/// The thread's side.
pub(crate) struct Owner {
    models: Served,
    /// Goal embeddings by goal and checkpoint, so that those of a swapped-out model are never used.
    embeddings: Embeddings,
    /// Jobs that were taken from the channel and are not done yet, in order.
    queue: VecDeque<Job>,
    published: watch::Sender<BTreeMap<String, ModelInfo>>,
    load: Arc<Load>,
    batch_size: usize,
    batch_delay: Duration,
}

impl Owner {
    pub(crate) fn new(
        config: &Config,
        models: Vec<Model>,
        published: watch::Sender<BTreeMap<String, ModelInfo>>,
        load: Arc<Load>,
    ) -> Self {
        Self {
            models: Served::new(models, config.retired_capacity.into()),
            embeddings: LruCache::new(config.goal_capacity.into()),
            queue: VecDeque::new(),
            published,
            load,
            batch_size: config.batch_size.get().into(),
            batch_delay: Duration::from_millis(config.batch_delay_ms.into()),
        }
    }

    /// Works until it is told to stop, or nobody is left to tell it anything.
    pub(crate) fn run(mut self, jobs: &mpsc::Receiver<Job>) {
        while let Some(job) = self.queue.pop_front().or_else(|| jobs.recv().ok()) {
            match job {
                Job::Plan(first) => {
                    let batch = self.gather(first, jobs);
                    self.answer(batch);
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

    /// What can be planned with the first: the tasks like it that wait, up to the next swap, as long as none would be late for
    /// the others' sake.
    fn gather(&mut self, first: Waiting, jobs: &mpsc::Receiver<Job>) -> Vec<Waiting> {
        let most = if first.task.is_anytime() { 1 } else { self.batch_size };
        self.listen(&first.task, most, jobs);
        let swap = self.queue.iter().position(|job| !matches!(job, Job::Plan(_))).unwrap_or(self.queue.len());
        let after = self.queue.split_off(swap);
        let mut due = first.due();
        let (mut batch, mut rest) = (vec![first], VecDeque::new());
        for job in self.queue.drain(..) {
            match job {
                Job::Plan(waiting) if batch.len() < most && waiting.task.is_like(&batch[0].task) => {
                    let earliest = due.into_iter().chain(waiting.due()).min();
                    if earliest.is_none_or(|due| Instant::now() + self.load.time(batch.len() + 1) <= due) {
                        due = earliest;
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

    /// Answers tasks of one kind, whatever happens: a fault of one ends neither the thread nor the others' plans.
    fn answer(&mut self, batch: Vec<Waiting>) {
        let started = Instant::now();
        let mut accepted = Vec::with_capacity(batch.len());
        for Waiting { task, enqueued, queued, place, reply } in batch {
            drop((place, queued));
            // A client that gave up has closed its end.
            let late = task.deadline.filter(|deadline| started - enqueued >= *deadline);
            match late.map_or_else(|| self.check(&task), |deadline| Err(too_late(deadline))) {
                _ if reply.is_given_up() => self.load.end(),
                Ok(()) => accepted.push((task, enqueued, reply)),
                Err(error) => self.reply(reply, Err(error)),
            }
        }
        let tasks: Vec<_> = accepted.iter().map(|(task, ..)| task).collect();
        let Some((first, enqueued, _)) = accepted.first() else { return };
        let mut clock = AnytimeClock::new(first.deadline, *enqueued);
        let mut plans = self.guarded(&tasks, &mut clock);
        if tasks.len() > 1 && plans.iter().any(Result::is_err) {
            // Which of them was at fault shows when each is alone.
            plans = tasks.iter().flat_map(|task| self.guarded(&[task], &mut clock)).collect();
        }
        // A search that fills its time says nothing of what others take.
        if !first.is_anytime() {
            self.load.measure(tasks.len(), started.elapsed());
        }
        histogram!("cpn_planner_batch_size").record(tasks.len() as f64);
        for ((_, enqueued, reply), mut plan) in accepted.into_iter().zip(plans) {
            if let Ok(response) = &mut plan {
                response.times.queue_seconds = (started - enqueued).as_secs_f64();
                observe(response.times);
            }
            self.reply(reply, plan);
        }
    }

    fn reply(&self, reply: Reply, answer: Answer) {
        self.load.end();
        reply.send(answer);
    }

    fn check(&mut self, task: &PlanTask) -> Result<(), Error> {
        self.models.get(&task.model, task.model_digest.as_deref())?.check(task)
    }

    /// Plans, one for each task; a panic is everybody's error.
    fn guarded(&mut self, tasks: &[&PlanTask], clock: &mut AnytimeClock) -> Vec<Answer> {
        catch_unwind(AssertUnwindSafe(|| self.plan(tasks, clock))).unwrap_or_else(|panic| {
            let reason = panic_message(&*panic);
            error!(model = tasks[0].model, reason, "planning panicked");
            vec![Err(Error::new(Code::Internal, "plan", "a plan", reason)); tasks.len()]
        })
    }

    /// Plans for tasks of one kind that were checked.
    fn plan(&mut self, tasks: &[&PlanTask], clock: &mut AnytimeClock) -> Vec<Answer> {
        let Self { models, embeddings, load, .. } = self;
        let PlanTask { model, model_digest, search, .. } = tasks[0];
        let model = models.get(model, model_digest.as_deref()).expect("checked");
        let digest = model.info.digest.clone();
        let started = Instant::now();
        let spans: Vec<_> = tasks.iter().map(|task| debug_span!(parent: &task.span, "encode")).collect();
        let (xs, x_gs) = encode(model, embeddings, tasks);
        drop(spans);
        let encoded = Instant::now();
        let ends = xs.iter().zip(&x_gs);
        let queries = tasks.iter().zip(ends);
        let queries = queries.map(|(task, (x, x_g))| Query { x, x_g, seed: task.seed, start: &task.warm_start });
        let queries: Vec<_> = queries.collect();
        let spans: Vec<_> = tasks.iter().map(|task| debug_span!(parent: &task.span, "search")).collect();
        let planned = model.plan(&queries, *search, || load.tasks() <= tasks.len() && clock.has_time());
        drop(spans);
        let times = StageTimes {
            queue_seconds: 0.0,
            encode_seconds: (encoded - started).as_secs_f64(),
            plan_seconds: encoded.elapsed().as_secs_f64(),
        };
        let answer = |(task, planned): (&&PlanTask, Result<Planned, Error>)| {
            let Planned { plan, latent_distance } = planned?;
            let first_action = plan.actions.first().into_iter().flatten().map(|v| v.clamp(-1.0, 1.0)).collect();
            let next = plan.actions.iter().skip(1).chain(plan.actions.last()).cloned();
            Ok(PlanResponse {
                first_action,
                warm_start: if plan.inner_losses.is_empty() { Vec::new() } else { next.collect() },
                iterations: plan.iterations as u32,
                iterations_run: plan.inner_losses.len().saturating_sub(1) as u32,
                actions: plan.actions,
                inner_losses: plan.inner_losses,
                latent_distance,
                times,
                model_digest: digest.clone(),
                goal_id: task.goal_id.clone(),
            })
        };
        tasks.iter().zip(planned).map(answer).collect()
    }
}

/// Embeddings by what was embedded and the checkpoint that did.
type Embeddings = LruCache<(String, String), Vec<f32>>;

/// Embeds every observation, and the goals that are not known yet.
fn encode(model: &mut Model, embeddings: &mut Embeddings, tasks: &[&PlanTask]) -> (Vec<Vec<f32>>, Vec<Vec<f32>>) {
    let key = |task: &PlanTask| (task.goal_id.clone(), model.info.digest.clone());
    let known: Vec<_> = tasks.iter().map(|task| embeddings.get(&key(task)).cloned()).collect();
    let unknown = tasks.iter().zip(&known).filter(|(_, known)| known.is_none()).map(|(task, _)| &*task.goal);
    let keys: Vec<_> = tasks.iter().map(|task| key(task)).collect();
    let inputs: Vec<_> = tasks.iter().map(|task| &task.observation).chain(unknown).collect();
    let mut xs = model.encode(&inputs);
    let mut new = xs.split_off(tasks.len()).into_iter();
    let x_gs: Vec<_> = known.into_iter().map(|known| known.or_else(|| new.next()).unwrap_or_default()).collect();
    keys.into_iter().zip(&x_gs).for_each(|(key, x_g)| drop(embeddings.put(key, x_g.clone())));
    (xs, x_gs)
}
/// Tells a search whether there is time for another iteration.
struct AnytimeClock {
    end: Instant,
    last: Instant,
    iterations: usize,
}

impl AnytimeClock {
    fn new(deadline: Option<Duration>, enqueued: Instant) -> Self {
        Self { end: enqueued + deadline.unwrap_or_default().mul_f64(USABLE), last: Instant::now(), iterations: 0 }
    }

    /// If the next takes as long as the last.
    fn has_time(&mut self) -> bool {
        let now = Instant::now();
        let took = now - std::mem::replace(&mut self.last, now);
        self.iterations += 1;
        now + took < self.end && self.iterations <= MOST_ITERATIONS
    }
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

/// What a panic says; `tch` panics with the message of libtorch.
fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic")
}
