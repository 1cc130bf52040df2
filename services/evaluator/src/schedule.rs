//! Hands trials to the workers that are alive, one at a time each.

use crate::link::Link;
use crate::planners::Planners;
use crate::presence::{Alive, Service};
use crate::progress::Progress;
use crate::queue::{Job, MAX_FAULTS, MAX_OUTAGES, Queue};
use crate::record::{Episode, FORMAT, Folder, Outcome, Run, Trial};
use crate::trial::{self, Attempt, Fault, Services};
use anyhow::{Context, bail};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinSet;
use wire::Error;
use wire::sim::Variation;

/// Pause of a worker after a fault: long enough for liveliness to tell whether it or the planner is gone.
const PAUSE: Duration = Duration::from_secs(1);

/// An evaluation under way.
#[derive(Debug)]
pub(crate) struct Schedule {
    run: Arc<Run>,
    folder: Folder,
    link: Link,
    queue: Queue,
    planners: Planners,
    /// Workers with a trial under way.
    busy: BTreeSet<String>,
    /// The task each worker is at.
    at: BTreeMap<String, String>,
    running: JoinSet<Finished>,
    progress: Progress,
}

/// Result of a trial's attempt.
#[derive(Debug)]
struct Finished {
    services: Services,
    job: Job,
    result: Result<Attempt, Fault>,
}

impl Schedule {
    /// Everything of the run that is not in the folder yet; errors are tried again.
    pub(crate) fn new(run: Arc<Run>, folder: Folder, link: Link) -> anyhow::Result<Self> {
        let mut finished = BTreeSet::new();
        for trial in folder.trials(&run)? {
            if let Some(model) = run.models.iter().position(|model| model.name == trial.model)
                && !matches!(trial.outcome, Outcome::Error { .. })
            {
                finished.insert((Variation { task: trial.task, seed: trial.seed }, model));
            }
        }
        let skipped = run.tasks.iter().map(|task| Ok((task.clone(), folder.skipped(task)?)));
        let queue = Queue::new(&run, finished, skipped.collect::<anyhow::Result<_>>()?);
        let total = run.tasks.len() * run.models.len() * run.trials as usize;
        let progress = Progress::new(total, queue.len(), run.models.iter().map(|model| model.name.clone()));
        let (busy, at, running) = (BTreeSet::new(), BTreeMap::new(), JoinSet::new());
        Ok(Self { run, folder, link, queue, planners: Planners::default(), busy, at, running, progress })
    }

    /// Checks, before anything is run, that workers know the tasks and that the models fit them: one reset of each task, and
    /// one plan of each model there. What does not answer now is left to the trials.
    ///
    /// # Errors
    /// If a request is refused as wrong.
    pub(crate) async fn check(&self) -> anyhow::Result<()> {
        let alive = self.link.alive.borrow().clone();
        let (Some(planner), workers) = (alive.planners.first(), alive.workers.len()) else { return Ok(()) };
        let mut checks = JoinSet::new();
        for (index, worker) in alive.workers.iter().enumerate() {
            // One after the other on each worker, which has one episode at a time.
            let variations = self.queue.first_variations().into_iter().skip(index).step_by(workers);
            let variations: Vec<_> = variations.collect();
            let services = Services { planner: planner.clone(), worker: worker.clone() };
            let (run, link) = (self.run.clone(), self.link.clone());
            checks.spawn(async move {
                for variation in variations {
                    trial::check(&link, &services, &run, &variation).await?;
                }
                anyhow::Ok(())
            });
        }
        while let Some(checked) = checks.join_next().await {
            checked.context("checking the tasks")??;
        }
        Ok(())
    }

    /// Runs every trial. Without planner or worker it waits for `patience`, then records what is left as errors.
    ///
    /// # Errors
    /// If a request is refused as wrong, a record cannot be written, or the user interrupts.
    pub(crate) async fn drive(mut self, patience: Duration) -> anyhow::Result<()> {
        let mut alive = self.link.alive.clone();
        let interrupted = service_kit::shutdown::requested();
        tokio::pin!(interrupted);
        loop {
            self.assign(&alive.borrow_and_update().clone());
            if self.running.is_empty() && self.queue.len() == 0 {
                return Ok(());
            }
            let idle = self.running.is_empty();
            if idle {
                let patience_secs = patience.as_secs();
                self.progress.say(|| tracing::warn!("waiting up to {patience_secs} s for a planner and a worker"));
            }
            tokio::select! {
                Some(finished) = self.running.join_next() => self.finish(finished.context("running a trial")?)?,
                changed = alive.changed() => changed.context("following liveliness tokens")?,
                () = tokio::time::sleep(patience), if idle => return self.give_up(patience),
                signal = &mut interrupted => {
                    signal.context("listening to signals")?;
                    bail!("interrupted with {} trials left; the same command goes on from here", self.left());
                }
            }
        }
    }

    /// Gives each idle worker a trial, as long as there is somebody to plan.
    fn assign(&mut self, alive: &Alive) {
        for worker in alive.workers.difference(&self.busy.clone()) {
            if self.queue.len() == 0 {
                return;
            }
            let Some(planner) = self.planners.assign(&alive.planners) else { return };
            let Some(job) = self.queue.next(self.at.get(worker).map(String::as_str)) else { return };
            self.busy.insert(worker.clone());
            self.at.insert(worker.clone(), job.variation.task.clone());
            let (run, link) = (self.run.clone(), self.link.clone());
            let services = Services { planner, worker: worker.clone() };
            self.running.spawn(async move {
                let model = &run.models[job.model];
                let result = trial::attempt(&link, &services, model, &job.variation, &run).await;
                if matches!(result, Err(Fault::Outage { .. } | Fault::Broken { .. })) {
                    tokio::time::sleep(PAUSE).await;
                }
                Finished { services, job, result }
            });
        }
    }

    fn finish(&mut self, Finished { services, job, result }: Finished) -> anyhow::Result<()> {
        let Services { planner, worker } = services;
        self.busy.remove(&worker);
        self.planners.release(&planner);
        match &result {
            Ok(_) => self.planners.clear(&planner),
            Err(Fault::Outage { by, .. } | Fault::Broken { by, .. }) => self.planners.suspect(by),
            Err(Fault::NoGoalImage | Fault::SolvedAtReset | Fault::Refused(_)) => (),
        }

        let model = &self.run.models[job.model].name;
        let Variation { task, seed } = &job.variation;
        match result {
            _ if self.queue.is_skipped(&job.variation) => (),
            Ok(attempt) => {
                // Before the record, which says that the trial is finished.
                self.folder.write_recording(&attempt.recording)?;
                self.record(&job, attempt.outcome.clone(), Some(attempt.episode))?;
                self.progress.count(job.model, attempt.outcome == Outcome::Success);
            }
            Err(Fault::SolvedAtReset) => {
                self.progress.say(|| tracing::info!("{task} {seed}, {model}: solved at reset, which is no attempt"));
                self.record(&job, Outcome::SolvedAtReset, None)?;
            }
            Err(Fault::NoGoalImage) => {
                self.progress.say(|| tracing::info!("{task} {seed}: skipped, the expert does not solve it"));
                self.queue.skip(&job.variation);
                self.folder.skip(task, *seed)?;
            }
            Err(Fault::Refused(error)) => bail!("{task} {seed}, {model}, worker {worker}: refused: {error}"),
            Err(Fault::Outage { by, error }) => self.again(Job { outages: job.outages + 1, ..job }, &by, &error)?,
            Err(Fault::Broken { by, error }) => self.again(Job { faults: job.faults + 1, ..job }, &by, &error)?,
        }
        self.progress.left(self.left());
        Ok(())
    }

    /// Lets a trial that did not come to its end begin anew, or records that it never did.
    fn again(&mut self, job: Job, by: &Service, error: &Error) -> anyhow::Result<()> {
        let model = &self.run.models[job.model].name;
        let (Variation { task, seed }, Job { outages, faults, .. }) = (&job.variation, &job);
        if job.may_begin_anew() {
            self.progress.say(|| {
                tracing::warn!(
                    "{task} {seed}, {model}: {by}: {error}; begins anew after {outages} of {MAX_OUTAGES} outages and {faults} \
                     of {MAX_FAULTS} faults"
                );
            });
            self.queue.retry(job);
        } else {
            let message = format!("{by}: {error}");
            self.progress.say(|| tracing::error!("{task} {seed}, {model}: {message}"));
            self.record(&job, Outcome::Error { message }, None)?;
        }
        Ok(())
    }

    fn record(&self, job: &Job, outcome: Outcome, episode: Option<Episode>) -> anyhow::Result<()> {
        let model = &self.run.models[job.model];
        let trial = Trial {
            format: FORMAT,
            task: job.variation.task.clone(),
            seed: job.variation.seed,
            model: model.name.clone(),
            model_digest: model.digest.clone(),
            goal: self.run.goal,
            planning: self.run.planning,
            outcome,
            episode,
        };
        self.folder.write_trial(&trial)
    }

    fn give_up(mut self, patience: Duration) -> anyhow::Result<()> {
        let jobs = self.queue.drain();
        let message = format!("no planner or no worker was alive for {} s", patience.as_secs());
        self.progress.say(|| tracing::error!("{message}: {} trials were not run", jobs.len()));
        for job in jobs {
            self.record(&job, Outcome::Error { message: message.clone() }, None)?;
        }
        Ok(())
    }

    fn left(&self) -> usize {
        self.queue.len() + self.running.len()
    }
}
