//! Paired comparison of two arms by the records of evaluations: the same variations, one difference.

use crate::paired::{self, Counts, RunOutcomes, TaskOutcomes};
use crate::record::{Folder, GoalSource, Outcome, Run, Trial};
use crate::summary::{self, CONFIDENCE};
use anyhow::{Context, bail, ensure};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Records of one model in the folder of an evaluation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Source {
    /// The folder.
    pub folder: PathBuf,
    /// The model; none for the only one.
    pub model: Option<String>,
}

impl FromStr for Source {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (folder, model) = match text.rsplit_once(':') {
            Some((folder, model)) if !model.contains('/') && !Path::new(text).is_dir() => (folder, Some(model)),
            _ => (text, None),
        };
        if folder.is_empty() || model == Some("") {
            return Err("expected FOLDER or FOLDER:MODEL".into());
        }
        Ok(Self { folder: folder.into(), model: model.map(Into::into) })
    }
}

/// Records of an arm, separated by commas.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sources(pub Vec<Source>);

impl FromStr for Sources {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        text.split(',').map(str::parse).collect::<Result<_, _>>().map(Self)
    }
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.folder.display())?;
        self.model.iter().try_for_each(|model| write!(f, ":{model}"))
    }
}

/// Comparison of two arms on the same variations. Differences are of success rates, A - B.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    /// Records of A, one for each training run.
    pub a: Vec<Source>,
    /// Records of B.
    pub b: Vec<Source>,
    /// Confidence of the intervals.
    pub confidence: f64,
    /// Method of the interval of the mean over the tasks.
    pub interval_method: &'static str,
    /// SHA-256 of the seeds, in hex, as in a summary.
    pub seeds_digest: String,
    /// One for each task, by name.
    pub tasks: Vec<TaskComparison>,
    /// Mean over the tasks of the difference, each with the same weight.
    pub difference: f64,
    /// Its interval.
    pub interval: (f64, f64),
    /// Discordant pairs of all tasks, and p of the exact McNemar test on them; none where an arm has several training runs.
    pub counts: Option<Counts>,
    /// The p.
    pub p: Option<f64>,
    /// As of a task.
    pub told_apart: bool,
}

/// The comparison at one task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TaskComparison {
    /// The task.
    pub task: String,
    /// Variations that were compared.
    pub variations: usize,
    /// Variations that were left out because the task was solved before any action.
    pub solved_at_reset: usize,
    /// Variations that were left out because a trial was not brought to an end.
    pub errors: usize,
    /// Training runs of A and of B.
    pub runs: (usize, usize),
    /// Success rates of A and of B, means over their training runs.
    pub rates: (f64, f64),
    /// Pairs by their outcomes; none where an arm has several training runs, whose outcomes on a variation are no independent pairs.
    pub counts: Option<Counts>,
    /// p of the exact McNemar test, two-sided, not adjusted for the number of tasks.
    pub p: Option<f64>,
    /// Difference of the rates.
    pub difference: f64,
    /// Its interval.
    pub interval: (f64, f64),
    /// Method of that interval.
    pub interval_method: &'static str,
    /// Whether the interval leaves out zero and p, if there is one, is below 1 - confidence: asymptotic intervals of few pairs alone
    /// promise too much.
    pub told_apart: bool,
}

/// One side of a comparison.
#[derive(Debug)]
struct Arm {
    name: &'static str,
    sources: Vec<Source>,
    records: Vec<Records>,
}

/// Trials of the model in one folder.
#[derive(Debug)]
struct Records {
    source: Source,
    run: Run,
    /// By task and seed.
    trials: BTreeMap<String, BTreeMap<u64, Trial>>,
}

/// Compares two arms, each of one model in one folder or, to tell methods apart by several training runs, in several.
///
/// # Errors
/// If a folder cannot be read or does not hold the model, or the arms were not evaluated on the same goals, action repeats, times
/// and variations.
pub fn compare(a: &[Source], b: &[Source]) -> anyhow::Result<Comparison> {
    let (a, b) = (Arm::read("A", a)?, Arm::read("B", b)?);
    check_same_settings(&a, &b)?;
    let tasks: BTreeSet<_> = a.tasks().into_iter().collect();
    let of_b: BTreeSet<_> = b.tasks().into_iter().collect();
    check_same("tasks", "A", &listed(&tasks), "B", &listed(&of_b))?;
    let (groups_a, groups_b) = (a.groups()?, b.groups()?);

    let mut rows = Vec::new();
    let mut outcomes = Vec::new();
    for task in tasks {
        let (row, of_task) = compare_task(task, (&a, &groups_a), (&b, &groups_b))?;
        rows.push(row);
        outcomes.push(of_task);
    }

    let single = a.is_single() && b.is_single();
    let counts = single.then(|| Counts::of(outcomes.iter().flat_map(pairs)));
    let (interval, p) = (paired::bootstrap(&outcomes), counts.map(paired::mcnemar));
    let trials = a.records.iter().flat_map(|records| records.trials.values().flat_map(BTreeMap::values));
    Ok(Comparison {
        confidence: CONFIDENCE,
        interval_method: if single { "bootstrap stratified by task" } else { BOOTSTRAP_OF_RUNS },
        seeds_digest: summary::seeds_digest(&summary::seeds(trials)),
        difference: rows.iter().map(|row| row.difference).sum::<f64>() / rows.len() as f64,
        interval,
        p,
        told_apart: told_apart(interval, p),
        counts,
        tasks: rows,
        a: a.sources,
        b: b.sources,
    })
}

const BOOTSTRAP_OF_RUNS: &str = "bootstrap of training runs and variations, stratified by task";

/// Compares at one task; with each arm come the groups of its records.
fn compare_task(
    task: &str,
    (a, groups_a): (&Arm, &[usize]),
    (b, groups_b): (&Arm, &[usize]),
) -> anyhow::Result<(TaskComparison, TaskOutcomes)> {
    let all: Vec<_> = [a, b].into_iter().flat_map(|arm| arm.at(task)).map(|(_, records)| records).collect();
    check_same_variations(task, &all)?;
    let any = |seed: &u64, is: fn(&Outcome) -> bool| all.iter().any(|records| is(&records.trials[task][seed].outcome));
    let seeds: Vec<u64> = all[0].trials[task].keys().copied().collect();
    let (solved, left): (Vec<u64>, Vec<u64>) =
        seeds.into_iter().partition(|seed| any(seed, |outcome| *outcome == Outcome::SolvedAtReset));
    let (errors, compared): (Vec<u64>, Vec<u64>) =
        left.into_iter().partition(|seed| any(seed, |outcome| matches!(outcome, Outcome::Error { .. })));
    ensure!(!compared.is_empty(), "{task}: expected variations that both arms brought to an end, got none");

    let outcomes = |arm: &Arm, groups: &[usize]| {
        let of_run = |records: &Records| {
            compared.iter().map(|seed| records.trials[task][seed].outcome == Outcome::Success).collect()
        };
        let runs: Vec<_> = arm.at(task).collect();
        RunOutcomes { group: groups[runs[0].0], solved: runs.iter().map(|(_, records)| of_run(records)).collect() }
    };
    let outcomes = TaskOutcomes { a: outcomes(a, groups_a), b: outcomes(b, groups_b) };
    let runs = (outcomes.a.solved.len(), outcomes.b.solved.len());
    let rates = (outcomes.a.rate(), outcomes.b.rate());
    let counts = (runs == (1, 1)).then(|| Counts::of(pairs(&outcomes)));
    let p = counts.map(paired::mcnemar);
    let interval = counts.map_or_else(|| paired::bootstrap(std::slice::from_ref(&outcomes)), paired::tango);
    let row = TaskComparison {
        task: task.to_owned(),
        variations: compared.len(),
        solved_at_reset: solved.len(),
        errors: errors.len(),
        runs,
        rates,
        counts,
        p,
        difference: rates.0 - rates.1,
        interval,
        told_apart: told_apart(interval, p),
        interval_method: if counts.is_some() { "Tango's score" } else { BOOTSTRAP_OF_RUNS },
    };
    Ok((row, outcomes))
}

fn told_apart((low, high): (f64, f64), p: Option<f64>) -> bool {
    (low > 0.0 || high < 0.0) && p.is_none_or(|p| p < 1.0 - CONFIDENCE)
}

/// Outcomes of the first run of each arm, by variation.
fn pairs(TaskOutcomes { a, b }: &TaskOutcomes) -> impl Iterator<Item = (bool, bool)> {
    a.solved[0].iter().copied().zip(b.solved[0].iter().copied())
}

impl Arm {
    fn read(name: &'static str, sources: &[Source]) -> anyhow::Result<Self> {
        let records = sources.iter().map(|source| Records::read(source).with_context(|| format!("{name}: {source}")));
        let records = records.collect::<anyhow::Result<Vec<_>>>()?;
        Ok(Self { name, sources: records.iter().map(|records| records.source.clone()).collect(), records })
    }

    fn tasks(&self) -> Vec<&str> {
        self.records.iter().flat_map(|records| records.trials.keys().map(String::as_str)).collect()
    }

    /// Records of a task, with their places.
    fn at(&self, task: &str) -> impl Iterator<Item = (usize, &Records)> {
        self.records.iter().enumerate().filter(move |(_, records)| records.trials.contains_key(task))
    }

    /// Whether there is one training run for each task.
    fn is_single(&self) -> bool {
        self.tasks().into_iter().all(|task| self.at(task).count() == 1)
    }

    /// The group of each of the records: those of the same tasks are training runs of the same.
    fn groups(&self) -> anyhow::Result<Vec<usize>> {
        let mut groups: Vec<&Records> = Vec::new();
        let mut of_records = Vec::new();
        for records in &self.records {
            let same = |other: &&Records| other.trials.keys().eq(records.trials.keys());
            let overlaps = |other: &&&Records| other.trials.keys().any(|task| records.trials.contains_key(task));
            if let Some(group) = groups.iter().position(same) {
                of_records.push(group);
                continue;
            }
            if let Some(other) = groups.iter().find(overlaps) {
                let tasks = |records: &Records| listed(records.trials.keys());
                bail!(
                    "{}: expected folders of the same tasks or of no task in common, got {} of {} and {} of {}",
                    self.name,
                    other.source,
                    tasks(other),
                    records.source,
                    tasks(records)
                );
            }
            of_records.push(groups.len());
            groups.push(records);
        }
        Ok(of_records)
    }
}

impl Records {
    fn read(source: &Source) -> anyhow::Result<Self> {
        let folder = Folder::new(&source.folder);
        let run = folder.read_run()?;
        let names: Vec<_> = run.models.iter().map(|model| &model.name).collect();
        let model = match (&source.model, names.as_slice()) {
            (Some(model), _) if names.contains(&model) => model.clone(),
            (Some(model), _) => bail!("expected one of its models, {}, got {model}", listed(&names)),
            (None, [model]) => (*model).clone(),
            (None, _) => bail!("expected FOLDER:MODEL with one of its models, {}", listed(&names)),
        };
        let mut trials: BTreeMap<String, BTreeMap<u64, Trial>> = BTreeMap::new();
        for trial in folder.trials(&run)?.into_iter().filter(|trial| trial.model == model) {
            trials.entry(trial.task.clone()).or_default().insert(trial.seed, trial);
        }
        ensure!(!trials.is_empty(), "expected trials of {model}, got none");
        Ok(Self { source: Source { model: Some(model), ..source.clone() }, run, trials })
    }
}

/// Checks that goals, applied actions and time are the same in all records.
fn check_same_settings(a: &Arm, b: &Arm) -> anyhow::Result<()> {
    let first = &a.records[0];
    for other in a.records.iter().chain(&b.records) {
        let (expected, got) = (&first.run, &other.run);
        let goal = |goal: GoalSource| serde_json::to_string(&goal).unwrap_or_default();
        let in_time = |real_time: bool| if real_time { "real" } else { "while nobody thinks" };
        let cases = [
            ("goals (--goal)", goal(expected.goal), goal(got.goal)),
            (
                "applied actions of a plan (--apply-actions)",
                expected.planning.apply_actions.to_string(),
                got.planning.apply_actions.to_string(),
            ),
            (
                "time of the simulation (--real-time)",
                in_time(expected.planning.real_time).into(),
                in_time(got.planning.real_time).into(),
            ),
        ];
        for (what, expected, got) in cases {
            check_same(what, &first.source.to_string(), &expected, &other.source.to_string(), &got)?;
        }
    }
    Ok(())
}

/// Checks that all records of a task are of the same variations, goals and number of steps.
fn check_same_variations(task: &str, all: &[&Records]) -> anyhow::Result<()> {
    let first = all[0];
    for other in &all[1..] {
        let (names, trials) = ([first, other].map(|records| records.source.to_string()), [first, other]);
        let [expected, got] = trials.map(|records| &records.trials[task]);
        let missing = |of: &BTreeMap<u64, Trial>, other: &BTreeMap<u64, Trial>| {
            listed(of.keys().filter(|seed| !other.contains_key(seed)).take(5))
        };
        let only = [missing(expected, got), missing(got, expected)];
        ensure!(
            only.iter().all(String::is_empty),
            "{task}: expected the same variations; only {} has seeds [{}], only {} has seeds [{}]",
            names[0],
            only[0],
            names[1],
            only[1]
        );

        for (seed, trial) in expected {
            let [Some(a), Some(b)] = [trial, &got[seed]].map(|trial| trial.episode.as_ref()) else { continue };
            let what = format!("goal of {task} {seed}");
            check_same(&what, &names[0], &a.goal_id, &names[1], &b.goal_id)?;
        }
        let [expected, got] = [expected, got].map(steps_of_failures);
        if !expected.is_empty() && !got.is_empty() {
            let what = format!("steps of an episode of {task}");
            check_same(&what, &names[0], &listed(&expected), &names[1], &listed(&got))?;
        }
    }
    Ok(())
}

fn steps_of_failures(trials: &BTreeMap<u64, Trial>) -> BTreeSet<u32> {
    let failures = trials.values().filter(|trial| trial.outcome == Outcome::Failure);
    failures.filter_map(|trial| trial.episode.as_ref()).map(|episode| episode.steps).collect()
}

fn check_same(what: &str, a: &str, expected: &str, b: &str, got: &str) -> anyhow::Result<()> {
    ensure!(expected == got, "{what}: expected the same, got {expected} in {a} and {got} in {b}");
    Ok(())
}

fn listed<T: fmt::Display>(values: impl IntoIterator<Item = T>) -> String {
    values.into_iter().map(|value| value.to_string()).collect::<Vec<_>>().join(", ")
}
