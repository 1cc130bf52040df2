//! Searches that take long: they are done in pieces, between which others are planned for.

use crate::load::{Load, SLICE};
use crate::served::Shared;
use crate::task::{Accepted, Answer, stopped, too_late};
use cpn::method::{Ongoing, Query};
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};
use tracing::{Span, debug_span};
use wire::planner::StageTimes;

/// The part of a deadline that a search may use which goes on until then; the answer must still be sent.
const USABLE: f64 = 0.9;

/// Searches that have begun. They take turns.
#[derive(Default)]
pub(crate) struct Searches {
    waiting: VecDeque<Searching>,
}

/// Tasks that are planned for together, one or more by gradient.
pub(crate) struct Searching {
    tasks: Vec<Accepted>,
    /// The embeddings of each, x and x_g.
    ends: Vec<(Vec<f32>, Vec<f32>)>,
    /// It stays the one that the search began with, whatever is swapped in.
    model: Shared,
    ongoing: Ongoing,
    /// Time it took so far.
    encoded: Duration,
    searched: Duration,
    /// Of the search of each.
    spans: Vec<Span>,
}

impl Searches {
    pub(crate) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Tasks that are searched for.
    pub(crate) fn tasks(&self) -> usize {
        self.waiting.iter().map(|searching| searching.tasks.len()).sum()
    }

    /// Takes in tasks that were embedded; each of them wants the same search.
    pub(crate) fn begin(
        &mut self,
        model: &Shared,
        tasks: Vec<Accepted>,
        ends: Vec<(Vec<f32>, Vec<f32>)>,
        encoded: Duration,
    ) {
        let spans = tasks.iter().map(|accepted| debug_span!(parent: &accepted.task.span, "search")).collect();
        let (model, ongoing) = (model.clone(), model.model().begin(tasks[0].task.search));
        self.waiting.push_back(Searching { tasks, ends, model, ongoing, encoded, searched: Duration::ZERO, spans });
    }

    /// Goes on with the search whose turn it is, for as long as [`SLICE`] or, if others wait, as `share`. Answers those who
    /// have waited long enough: an answer and its addressee each.
    pub(crate) fn go_on(&mut self, load: &Load, share: Duration) -> Vec<(Accepted, Answer)> {
        let searching_for = self.tasks();
        let Some(mut search) = self.waiting.pop_front() else { return Vec::new() };
        let mut answers = search.dismiss(load);
        if search.tasks.is_empty() {
            return answers;
        }

        let alone = search.tasks.len() == 1;
        let (others, anyone) = (|| load.tasks() > searching_for, || load.tasks() > 1);
        let task = &search.tasks[0];
        let end = task.task.is_anytime().then(|| {
            let deadline = task.task.deadline.unwrap_or_default();
            task.enqueued + deadline.mul_f64(USABLE)
        });
        let (started, before) = (Instant::now(), search.ongoing.rollouts());
        let mut last = started;
        let mut longest = Duration::ZERO;
        // Whether there is time for another piece, if it takes as long as the last.
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
        // Where a search begins it is not like the rest.
        if before > 0 {
            load.measure(&search.tasks[0].task.model, |costs| costs.rolled_out(solver, rollouts, took));
        }

        if let Err(panic) = searched {
            if alone {
                let error = crate::owner::panicked(&search.tasks[0].task, &*panic);
                answers.extend(search.tasks.into_iter().map(|accepted| (accepted, Err(error.clone()))));
            } else {
                // Which of them was at fault shows when each is alone.
                for (accepted, ends) in search.tasks.into_iter().zip(search.ends) {
                    self.begin(&search.model, vec![accepted], vec![ends], search.encoded);
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

impl Searching {
    /// Takes out those for whom it is too late, or who have gone.
    fn dismiss(&mut self, load: &Load) -> Vec<(Accepted, Answer)> {
        let mut dismissed = Vec::new();
        for index in (0..self.tasks.len()).rev() {
            let Accepted { task, enqueued, reply, .. } = &self.tasks[index];
            let late = task.deadline.filter(|deadline| enqueued.elapsed() >= *deadline);
            let error = match late {
                _ if load.is_given_up() => stopped(),
                Some(deadline) => too_late(deadline),
                None if reply.is_given_up() => stopped(),
                None => continue,
            };
            dismissed.push((self.tasks.remove(index), Err(error)));
            self.ends.remove(index);
            self.spans.remove(index);
            self.ongoing.remove(index);
        }
        dismissed
    }

    fn resume(&mut self, go_on: &mut dyn FnMut() -> bool) {
        let queries = queries(&self.tasks, &self.ends);
        self.model.model().method.resume(&queries, &mut self.ongoing, go_on);
    }

    fn finish(self) -> Vec<(Accepted, Answer)> {
        let Self { tasks, ends, model, ongoing, encoded, searched, .. } = self;
        let plans = ongoing.into_plans();
        let answers = plans.into_iter().zip(queries(&tasks, &ends)).zip(&tasks).map(|((plan, query), accepted)| {
            let times = StageTimes {
                queue_seconds: accepted.enqueued.elapsed().saturating_sub(encoded + searched).as_secs_f64(),
                encode_seconds: encoded.as_secs_f64(),
                plan_seconds: searched.as_secs_f64(),
            };
            model.model().response(&accepted.task, plan, &query, times)
        });
        let answers: Vec<_> = answers.collect();
        tasks.into_iter().zip(answers).collect()
    }
}

/// What is asked of a method.
fn queries<'a>(tasks: &'a [Accepted], ends: &'a [(Vec<f32>, Vec<f32>)]) -> Vec<Query<'a>> {
    let queries = tasks.iter().zip(ends);
    queries
        .map(|(Accepted { task, .. }, (x, x_g))| Query { x, x_g, seed: task.seed, start: &task.warm_start })
        .collect()
}
