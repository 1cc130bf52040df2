//! Sliced searches: long searches that run in time slices, between which other tasks are planned.

use crate::load::{Load, SLICE};
use crate::served::Shared;
use crate::task::{Accepted, Answer, Latents, deadline_exceeded, shutting_down};
use cpn::method::{Ongoing, Query};
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};
use tracing::{Span, debug_span};
use wire::planner::StageTimes;

/// Fraction of its deadline that an anytime search uses; the rest is for sending the answer.
const USABLE: f64 = 0.9;

/// Sliced searches in progress, in round-robin order.
#[derive(Default)]
pub(crate) struct Searches {
    waiting: VecDeque<SlicedSearch>,
}

/// Sliced search of a batch: several tasks by gradient, or a single one.
pub(crate) struct SlicedSearch {
    tasks: Vec<Accepted>,
    /// Embeddings of each task.
    latents: Vec<Latents>,
    /// Model at the search's begin, kept across swaps.
    model: Shared,
    ongoing: Ongoing,
    /// Time spent on embedding.
    encoded: Duration,
    /// Time spent on the search so far.
    searched: Duration,
    /// Tracing span of each task's search.
    spans: Vec<Span>,
}

impl Searches {
    pub(crate) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Number of tasks in all searches.
    pub(crate) fn tasks(&self) -> usize {
        self.waiting.iter().map(|search| search.tasks.len()).sum()
    }

    /// Begins the search of a batch of embedded tasks.
    pub(crate) fn begin(&mut self, model: &Shared, tasks: Vec<Accepted>, latents: Vec<Latents>, encoded: Duration) {
        let spans = tasks.iter().map(|accepted| debug_span!(parent: &accepted.task.span, "search")).collect();
        let (model, ongoing) = (model.clone(), model.model().begin(tasks[0].task.search));
        self.waiting.push_back(SlicedSearch {
            tasks,
            latents,
            model,
            ongoing,
            encoded,
            searched: Duration::ZERO,
            spans,
        });
    }

    /// Advances the next search, by [`SLICE`] or, if other tasks wait, by `share`. Returns the tasks that are done, with their
    /// answers.
    pub(crate) fn advance(&mut self, load: &Load, share: Duration) -> Vec<(Accepted, Answer)> {
        let own_tasks = self.tasks();
        let Some(mut search) = self.waiting.pop_front() else { return Vec::new() };
        let mut answers = search.remove_expired(load);
        if search.tasks.is_empty() {
            return answers;
        }

        let alone = search.tasks.len() == 1;
        let (others, anyone) = (|| load.tasks() > own_tasks, || load.tasks() > 1);
        let task = &search.tasks[0];
        let end = task.task.is_anytime().then(|| {
            let deadline = task.task.deadline.unwrap_or_default();
            task.enqueued + deadline.mul_f64(USABLE)
        });

        let (started, before) = (Instant::now(), search.ongoing.rollouts());
        let mut last = started;
        let mut longest = Duration::ZERO;
        // Whether there is time for another iteration, if it takes as long as the last.
        let mut has_time = |now: Instant| {
            longest = now - std::mem::replace(&mut last, now);
            end.is_none_or(|end| now + longest < end)
        };
        let mut go_on = || {
            let now = Instant::now();
            let limit = if others() { share } else { SLICE };
            has_time(now) && now - started < limit && !(end.is_some() && anyone())
        };

        let searched = catch_unwind(AssertUnwindSafe(|| search.resume(&mut go_on)));
        let took = started.elapsed();
        search.searched += took;
        let rollouts = search.ongoing.rollouts() - before;
        let solver = search.ongoing.solver();
        // The first slice includes the set-up of the search.
        if before > 0 {
            load.measure(&search.tasks[0].task.model, |costs| costs.record_rollouts(solver, rollouts, took));
        }

        if let Err(panic) = searched {
            if alone {
                let error = crate::owner::panicked(&search.tasks[0].task, &*panic);
                answers.extend(search.tasks.into_iter().map(|accepted| (accepted, Err(error.clone()))));
            } else {
                // Searched one by one, so that only the faulty task fails.
                for (accepted, latents) in search.tasks.into_iter().zip(search.latents) {
                    self.begin(&search.model, vec![accepted], vec![latents], search.encoded);
                }
            }
            return answers;
        }

        let now = Instant::now();
        let no_longer = end.is_some_and(|end| anyone() || now + longest >= end);
        if search.ongoing.is_over() || no_longer {
            answers.extend(search.finish());
        } else {
            self.waiting.push_back(search);
        }
        answers
    }
}

impl SlicedSearch {
    /// Removes tasks that are past their deadline, cancelled or aborted, with their errors.
    fn remove_expired(&mut self, load: &Load) -> Vec<(Accepted, Answer)> {
        let mut removed = Vec::new();
        for index in (0..self.tasks.len()).rev() {
            let Accepted { task, enqueued, reply, .. } = &self.tasks[index];
            let late = task.deadline.filter(|deadline| enqueued.elapsed() >= *deadline);
            let error = match late {
                _ if load.is_aborted() => shutting_down(),
                Some(deadline) => deadline_exceeded(deadline),
                None if reply.is_cancelled() => shutting_down(),
                None => continue,
            };
            removed.push((self.tasks.remove(index), Err(error)));
            self.latents.remove(index);
            self.spans.remove(index);
            self.ongoing.remove(index);
        }
        removed
    }

    fn resume(&mut self, go_on: &mut dyn FnMut() -> bool) {
        let queries = queries(&self.tasks, &self.latents);
        self.model.model().method.resume(&queries, &mut self.ongoing, go_on);
    }

    fn finish(self) -> Vec<(Accepted, Answer)> {
        let Self { tasks, latents, model, ongoing, encoded, searched, .. } = self;
        let plans = ongoing.into_plans();
        let answers = plans.into_iter().zip(&latents).zip(&tasks).map(|((plan, latents), accepted)| {
            let times = StageTimes {
                queue_seconds: accepted.enqueued.elapsed().saturating_sub(encoded + searched).as_secs_f64(),
                encode_seconds: encoded.as_secs_f64(),
                plan_seconds: searched.as_secs_f64(),
            };
            model.model().response(&accepted.task, plan, latents, times)
        });
        let answers: Vec<_> = answers.collect();
        tasks.into_iter().zip(answers).collect()
    }
}

/// Queries of the tasks, for the method.
fn queries<'a>(tasks: &'a [Accepted], latents: &'a [Latents]) -> Vec<Query<'a>> {
    tasks.iter().zip(latents).map(|(Accepted { task, .. }, latents)| task.query(latents)).collect()
}
