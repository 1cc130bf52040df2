//! Summary and comparison in a terminal.

use crate::compare::{Comparison, Source, TaskComparison};
use crate::paired::Counts;
use crate::record::GoalSource;
use crate::summary::{Row, Summary};
use comfy_table::{CellAlignment, LineStyle, Table, presets};
use std::collections::BTreeSet;

/// Remark on a run with seeds of demonstrations.
pub(crate) const DEMONSTRATION_SEEDS: &str = "not an evaluation: the seeds are those of demonstrations, so that models may have been trained on the very variations";

/// The summary as a table, one row for each task and model, followed by what was set, what does not count and what went wrong.
/// Progress is the mean of the best of an episode, then of its last.
pub fn table(summary: &Summary) -> String {
    let interval = format!("{:.0} % interval", 100.0 * summary.confidence);
    let header = ["task", "model", "task was", "successes", "rate", &interval, "steps", "progress", "errors"];
    let mut table = Table::new();
    table.load_style(presets::UTF8_HORIZONTAL_ONLY.row_separator(LineStyle::none())).set_header(header);
    for row in &summary.rows {
        table.add_row(cells(row));
    }
    for column in table.column_iter_mut().skip(3) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    let errors = summary.rows.iter().filter_map(|row| {
        let error = row.first_error.as_ref()?;
        let count = if row.errors == 1 { "1 error".into() } else { format!("{} errors, the first", row.errors) };
        Some(format!("\n{}, {}: {count}: {error}", row.task, row.model))
    });
    let ablation = match summary.run.goal {
        GoalSource::SameVariation => "",
        GoalSource::OtherVariation => "\nablation: the goal shows the end of another variation",
    };
    let planning = summary.run.planning;
    let planning = if planning.is_default() { String::new() } else { format!("\nplans: {planning}") };
    let solved = summary.rows.iter().filter(|row| row.solved_at_reset > 0);
    let solved = solved.map(|row| {
        format!(
            "\n{}, {}: {} solved at reset, which are no attempts and not counted",
            row.task, row.model, row.solved_at_reset
        )
    });
    let seeds = if summary.demonstration_seeds { format!("\n{DEMONSTRATION_SEEDS}") } else { String::new() };
    format!("{table}{ablation}{planning}{seeds}{}", solved.chain(errors).collect::<String>())
}

fn cells(row: &Row) -> [String; 9] {
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| "–".into());
    [
        row.task.clone(),
        row.model.clone(),
        row.training.label().into(),
        format!("{}/{}", row.successes, row.trials),
        or_dash(row.rate.map(|rate| format!("{:.0} %", 100.0 * rate))),
        or_dash(row.interval.map(|(low, high)| format!("{:.0} to {:.0} %", 100.0 * low, 100.0 * high))),
        or_dash(row.mean_success_steps.map(|steps| format!("{steps:.0}"))),
        or_dash(row.mean_best_progress.zip(row.mean_final_progress).map(|(best, last)| format!("{best:.2} {last:.2}"))),
        if row.errors > 0 { row.errors.to_string() } else { "–".into() },
    ]
}

/// The comparison as a table, one row for each task and one for their mean, followed by the arms and the methods.
pub fn comparison_table(comparison: &Comparison) -> String {
    let interval = format!("{:.0} % interval", 100.0 * comparison.confidence);
    let header = ["task", "A", "B", "A only", "B only", "McNemar p", "A - B", &interval, "told apart"];
    let mut table = Table::new();
    table.load_style(presets::UTF8_HORIZONTAL_ONLY.row_separator(LineStyle::none())).set_header(header);
    for TaskComparison { task, rates, counts, p, difference, interval, told_apart, .. } in &comparison.tasks {
        let rates = [rates.0, rates.1].map(|rate| format!("{:.0} %", 100.0 * rate));
        table.add_row(compared(task, rates, *counts, *p, *difference, *interval, *told_apart));
    }
    let Comparison { counts, p, difference, interval, told_apart, .. } = comparison;
    let mean = |rate: fn(&TaskComparison) -> f64| {
        let rates: Vec<_> = comparison.tasks.iter().map(rate).collect();
        format!("{:.0} %", 100.0 * rates.iter().sum::<f64>() / rates.len() as f64)
    };
    let rates = [mean(|task| task.rates.0), mean(|task| task.rates.1)];
    table.add_row(compared("mean of the tasks", rates, *counts, *p, *difference, *interval, *told_apart));
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }

    let arm = |sources: &[Source]| sources.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    let total = |count: fn(&TaskComparison) -> usize| comparison.tasks.iter().map(count).sum::<usize>();
    let (variations, solved, errors) =
        (total(|task| task.variations), total(|task| task.solved_at_reset), total(|task| task.errors));
    let methods: BTreeSet<_> = comparison.tasks.iter().map(|task| task.interval_method).collect();
    format!(
        "{table}\nA: {}\nB: {}\n{variations} variations; left out: {solved} solved at reset, {errors} not brought to an end; \
         SHA-256 of the seeds {}\nintervals: of a task {}, of the mean {}; p is not adjusted for the number of tasks",
        arm(&comparison.a),
        arm(&comparison.b),
        comparison.seeds_digest,
        methods.into_iter().collect::<Vec<_>>().join(" or "),
        comparison.interval_method,
    )
}

/// A row of the comparison.
fn compared(
    name: &str,
    [a, b]: [String; 2],
    counts: Option<Counts>,
    p: Option<f64>,
    difference: f64,
    (low, high): (f64, f64),
    told_apart: bool,
) -> [String; 9] {
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| "–".into());
    let percent = |share: f64| format!("{:+.0}", 100.0 * share);
    [
        name.into(),
        a,
        b,
        or_dash(counts.map(|counts| counts.a_only.to_string())),
        or_dash(counts.map(|counts| counts.b_only.to_string())),
        or_dash(p.map(|p| format!("{p:.3}"))),
        format!("{} %", percent(difference)),
        format!("{} to {} %", percent(low), percent(high)),
        if told_apart { "yes" } else { "no" }.into(),
    ]
}
