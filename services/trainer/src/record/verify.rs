//! Verification of a dataset: statistics and faults.

use crate::record::folder::{self, dataset_digest};
use anyhow::Context;
use comfy_table::{CellAlignment, LineStyle, Table, presets};
use rayon::prelude::*;
use recording::Episode;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;
use wire::demonstration::{DemonstrationStep, RecordedEpisode};

/// Movement of the hand between two steps, in metres, above which the frame must change: half of the largest of one action.
const VISIBLE_METRES: f32 = 0.005;

/// Report on a dataset.
#[derive(Debug, Serialize)]
pub struct Report {
    /// Statistics of each task, ordered by name.
    pub tasks: Vec<TaskReport>,
    /// SHA-256 of the dataset, in hex, as in the provenance of a checkpoint trained on all of it.
    pub digest: String,
    /// All faults, each with its place.
    pub faults: Vec<String>,
}

/// Statistics of one task.
#[derive(Debug, Serialize)]
pub struct TaskReport {
    /// Name of the task.
    pub task: String,
    /// Number of episodes.
    pub episodes: usize,
    /// Number of seeds between the first and the last without an episode, such as variations that an expert does not solve.
    pub skipped_seeds: u64,
    /// Mean number of steps of an episode.
    pub steps_mean: f64,
    /// Mean size of a recording, in bytes.
    pub bytes_mean: f64,
}

/// Summary of one recording.
struct Facts {
    info: RecordedEpisode,
    bytes: u64,
    constant_action: bool,
    faults: Vec<String>,
}

/// Verifies all recordings of `folder`, on all cores, with one recording per core in memory. Fewer than `tasks` tasks, or fewer
/// than `episodes` episodes of a task, are a fault.
///
/// # Errors
/// If the folder cannot be read; faults inside it are in the report.
pub fn run(folder: &Path, tasks: usize, episodes: usize) -> anyhow::Result<Report> {
    let paths = folder::paths(folder)?;
    let read: Vec<_> = paths.par_iter().map(|path| facts(folder, path)).collect();
    let mut by_task: BTreeMap<String, Vec<Facts>> =
        folder::tasks(folder)?.into_iter().map(|task| (task, Vec::new())).collect();
    let mut faults = Vec::new();
    for (path, facts) in paths.iter().zip(read) {
        match facts {
            Ok(facts) => {
                let place = path.strip_prefix(folder).unwrap_or(path).display();
                faults.extend(facts.faults.iter().map(|fault| format!("{place}: {fault}")));
                by_task.entry(facts.info.variation.task.clone()).or_default().push(facts);
            }
            Err(fault) => faults.push(format!("{fault:#} (remove the file and record it again)")),
        }
    }

    faults.extend(folder::duplicates(&paths));
    if by_task.len() < tasks {
        faults.push(format!("expected at least {tasks} tasks, got {}", by_task.len()));
    }
    for (task, found) in &by_task {
        if found.len() < episodes {
            faults.push(format!("{task}: expected at least {episodes} episodes, got {}", found.len()));
        }
        if !found.is_empty() && found.iter().all(|facts| facts.constant_action) {
            faults.push(format!("{task}: expected actions that change, got constant ones in every episode"));
        }
    }

    let all = || by_task.values().flatten();
    faults.extend(mixed("render_spec", all().map(|facts| facts.info.render_spec.clone())));
    faults.extend(mixed("control_hz", all().map(|facts| facts.info.control_hz.to_string())));
    if paths.is_empty() {
        faults.push(format!("{}: expected recordings, got none", folder.display()));
    }
    let digest = dataset_digest(all().map(|facts| &facts.info));
    Ok(Report { tasks: by_task.iter().map(|(task, found)| summarise(task, found)).collect(), digest, faults })
}

fn facts(folder: &Path, path: &Path) -> anyhow::Result<Facts> {
    let episode = folder::read(folder, path)?;
    let bytes = path.metadata().with_context(|| path.display().to_string())?.len();
    let actions: Vec<_> = episode.steps().iter().filter_map(|step| step.action.as_ref()).collect();
    Ok(Facts {
        info: episode.info().clone(),
        bytes,
        constant_action: actions.windows(2).all(|pair| pair[0] == pair[1]),
        faults: faults(&episode),
    })
}

/// Faults inside a valid episode; the range of its actions is checked when it is read.
fn faults(episode: &Episode) -> Vec<String> {
    let steps = episode.steps();
    let mut faults = Vec::new();
    let same = |pair: &&[DemonstrationStep]| pair[0].frame == pair[1].frame;
    if steps.windows(2).all(|pair| same(&pair)) {
        faults.push("expected frames that change, got the same in every step".to_owned());
    } else {
        let stuck = steps.windows(2).filter(same).filter_map(|pair| {
            let moved = hand_moved_metres(&pair[0], &pair[1]).filter(|moved| *moved > VISIBLE_METRES)?;
            let (before, after) = (pair[0].step, pair[1].step);
            Some(format!("expected another frame at step {after} than at {before}: the hand moved {moved:.4} m"))
        });
        faults.extend(stuck);
    }
    if !steps.last().is_some_and(|step| step.success) {
        faults.push("expected success at the last step, got none".to_owned());
    }
    faults
}

/// Movement of the hand between two steps, in metres; none if the states have fewer than 3 values.
fn hand_moved_metres(before: &DemonstrationStep, after: &DemonstrationStep) -> Option<f32> {
    let hands = before.state.get(..3)?.iter().zip(after.state.get(..3)?);
    Some(hands.map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt())
}

/// Fault of a field with several values in a dataset.
fn mixed(field: &str, values: impl Iterator<Item = String>) -> Option<String> {
    let values: BTreeSet<String> = values.collect();
    (values.len() > 1).then(|| format!("{field}: expected one, got {}: {values:?}", values.len()))
}

fn summarise(task: &str, found: &[Facts]) -> TaskReport {
    let seeds: BTreeSet<u64> = found.iter().map(|facts| facts.info.variation.seed).collect();
    // An empty sum is -0.0 in Rust.
    let mean = |value: fn(&Facts) -> f64| (found.iter().map(value).sum::<f64>() + 0.0) / found.len().max(1) as f64;
    let tries = seeds.last().zip(seeds.first()).map_or(0, |(largest, smallest)| (largest - smallest).saturating_add(1));
    TaskReport {
        task: task.to_owned(),
        episodes: found.len(),
        skipped_seeds: tries - seeds.len() as u64,
        steps_mean: mean(|facts| facts.info.steps.into()),
        bytes_mean: mean(|facts| facts.bytes as f64),
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut table = Table::new();
        table.load_style(presets::UTF8_HORIZONTAL_ONLY.row_separator(LineStyle::none()));
        table.set_header(["task", "episodes", "skipped seeds", "steps (mean)", "bytes (mean)"]);
        for TaskReport { task, episodes, skipped_seeds, steps_mean, bytes_mean } in &self.tasks {
            let (steps, bytes) = (format!("{steps_mean:.1}"), format!("{bytes_mean:.0}"));
            table.add_row([task.clone(), episodes.to_string(), skipped_seeds.to_string(), steps, bytes]);
        }
        for column in table.column_iter_mut().skip(1) {
            column.set_cell_alignment(CellAlignment::Right);
        }
        let episodes: usize = self.tasks.iter().map(|task| task.episodes).sum();
        writeln!(f, "{table}\n\n{episodes} episodes, dataset digest {}", self.digest)?;
        self.faults.iter().try_for_each(|fault| writeln!(f, "fault: {fault}"))
    }
}
