//! The report as one HTML file that needs nothing else.

use crate::chart::{BarChart, Line};
use crate::filmstrip::Filmstrip;
use crate::record::{Folder, Outcome, Run, Trial};
use crate::summary::{Row, Summary};
use crate::table::DEMONSTRATION_SEEDS;
use anyhow::Context;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use minijinja::Environment;
use minijinja::value::Serde;
use serde::Serialize;
use std::collections::BTreeSet;

const TEMPLATE: &str = include_str!("../templates/report.html");

/// Colours for so many models are told apart; then they begin anew.
const COLOURS: usize = 6;
/// The same of controls.
const GREYS: usize = 3;

/// Input of the template.
#[derive(Debug, Serialize)]
struct Page<'a> {
    run: &'a Run,
    confidence: String,
    interval_method: &'a str,
    /// Settings of plans in closed loop.
    planning: String,
    solved_at_reset: usize,
    errors: usize,
    /// Remark on seeds of demonstrations; empty for others.
    seeds_warning: &'a str,
    legend: Vec<LegendEntry<'a>>,
    /// Each task with its seeds.
    seeds: Vec<(&'a str, String)>,
    seeds_digest: &'a str,
    chart: BarChart,
    /// The rows of each task.
    tasks: Vec<&'a [TableRow<'a>]>,
    version: &'a str,
}

/// A model in the set-up and the legend.
#[derive(Debug, Serialize)]
struct LegendEntry<'a> {
    name: &'a str,
    method: &'a str,
    digest: &'a str,
    horizon: u32,
    training_tasks: &'a [String],
    /// Class of its colour.
    colour: String,
}

/// A row of the table.
#[derive(Debug, Serialize)]
struct TableRow<'a> {
    #[serde(flatten)]
    row: &'a Row,
    training_label: &'static str,
    colour: String,
    /// Its first success and first failure.
    success: Option<Strip>,
    failure: Option<Strip>,
}

/// A filmstrip with what is told about its trial.
#[derive(Debug, Serialize)]
struct Strip {
    seed: u64,
    steps: u32,
    /// Images are base64 of PNGs.
    goal: String,
    frames: Vec<Frame>,
    distance: Option<Line>,
    progress: Option<Line>,
    first_inner_losses: Vec<Option<f32>>,
    last_inner_losses: Vec<Option<f32>>,
    /// Mean times in milliseconds.
    encode_ms: f64,
    plan_ms: f64,
    queue_ms: f64,
}

#[derive(Debug, Serialize)]
struct Frame {
    step: u32,
    png: String,
}

/// The report of a run.
///
/// # Errors
/// If the template is faulty.
pub(crate) fn html(summary: &Summary, trials: &[Trial], folder: &Folder) -> anyhow::Result<String> {
    let models = summary.run.models.len();
    let mut rows = Vec::new();
    for (index, row) in summary.rows.iter().enumerate() {
        let of_row: Vec<_> = trials.iter().filter(|t| t.task == row.task && t.model == row.model).collect();
        rows.push(TableRow {
            row,
            training_label: row.training.label(),
            colour: colour(&summary.run, index % models),
            success: strip(&of_row, &Outcome::Success, folder),
            failure: strip(&of_row, &Outcome::Failure, folder),
        });
    }
    let page = Page {
        run: &summary.run,
        confidence: format!("{:.0} %", 100.0 * summary.confidence),
        interval_method: summary.interval_method,
        planning: summary.run.planning.to_string(),
        solved_at_reset: summary.solved_at_reset(),
        errors: summary.errors(),
        seeds_warning: if summary.demonstration_seeds { DEMONSTRATION_SEEDS } else { "" },
        legend: (0..models).map(|index| legend_entry(&summary.run, index)).collect(),
        seeds: summary.run.tasks.iter().map(|task| (task.as_str(), ranges(summary.seeds.get(task)))).collect(),
        seeds_digest: &summary.seeds_digest,
        chart: BarChart::new(summary),
        tasks: rows.chunks(models).collect(),
        version: env!("CARGO_PKG_VERSION"),
    };
    let mut environment = Environment::new();
    environment.add_template("report.html", TEMPLATE).context("the report's template")?;
    let template = environment.get_template("report.html").context("the report's template")?;
    template.render(Serde(&page)).context("the report's template")
}

fn legend_entry(run: &Run, index: usize) -> LegendEntry<'_> {
    let model = &run.models[index];
    LegendEntry {
        name: &model.name,
        method: &model.method,
        digest: &model.digest,
        horizon: model.horizon,
        training_tasks: &model.training_tasks,
        colour: colour(run, index),
    }
}

/// Class of a model's colour: one of the greys for a control, else by its place among the others.
fn colour(run: &Run, index: usize) -> String {
    let is_control = run.models[index].is_control();
    let before = run.models[..index].iter().filter(|model| model.is_control() == is_control).count();
    if is_control { format!("g{}", before % GREYS) } else { format!("c{}", before % COLOURS) }
}

/// The filmstrip of the first trial with an outcome; none if its recording cannot be read.
fn strip(trials: &[&Trial], outcome: &Outcome, folder: &Folder) -> Option<Strip> {
    let trial = trials.iter().find(|trial| trial.outcome == *outcome)?;
    let episode = trial.episode.as_ref()?;
    let Filmstrip { goal, frames } =
        Filmstrip::of(trial, folder).inspect_err(|error| tracing::warn!("no filmstrip: {error:#}")).ok()?;

    let ms = |seconds: f64| 1e3 * seconds;
    let distances = episode.latent_distances.iter().enumerate();
    let distances: Vec<_> = distances.map(|(plan, distance)| (episode.plan_step(plan), *distance)).collect();
    let progress: Vec<_> = (0..).zip(episode.progress.iter().map(|value| Some(*value as f32))).collect();
    Some(Strip {
        seed: trial.seed,
        steps: episode.steps,
        goal: STANDARD.encode(goal),
        distance: Line::new(&distances, episode.steps, frames.len()),
        progress: Line::new(&progress, episode.steps, frames.len()),
        frames: frames.into_iter().map(|(step, png)| Frame { step, png: STANDARD.encode(png) }).collect(),
        first_inner_losses: episode.first_inner_losses.clone(),
        last_inner_losses: episode.last_inner_losses.clone(),
        encode_ms: ms(episode.mean_times.encode_seconds),
        plan_ms: ms(episode.mean_times.plan_seconds),
        queue_ms: ms(episode.mean_times.queue_seconds),
    })
}

/// Seeds as ranges: `1000000–1000003, 1000005`.
fn ranges(seeds: Option<&BTreeSet<u64>>) -> String {
    let mut ranges: Vec<(u64, u64)> = Vec::new();
    for &seed in seeds.into_iter().flatten() {
        match ranges.last_mut() {
            Some((_, last)) if *last + 1 == seed => *last = seed,
            _ => ranges.push((seed, seed)),
        }
    }
    let range =
        |(first, last): &(u64, u64)| if first == last { first.to_string() } else { format!("{first}–{last}") };
    ranges.iter().map(range).collect::<Vec<_>>().join(", ")
}
