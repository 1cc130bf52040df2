//! The summary in a terminal.

use crate::record::GoalSource;
use crate::summary::{Row, Summary};
use comfy_table::{CellAlignment, LineStyle, Table, presets};

/// Remark on a run with seeds of demonstrations.
pub(crate) const DEMONSTRATION_SEEDS: &str = "not an evaluation: the seeds are those of demonstrations, so that models may have been trained on the very variations";

/// The summary as a table, one row for each task and model, followed by what went wrong.
pub fn table(summary: &Summary) -> String {
    let interval = format!("{:.0} % interval", 100.0 * summary.confidence);
    let header = ["task", "model", "task was", "successes", "rate", &interval, "steps", "errors"];
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
    let seeds = if summary.demonstration_seeds { format!("\n{DEMONSTRATION_SEEDS}") } else { String::new() };
    format!("{table}{ablation}{seeds}{}", errors.collect::<String>())
}

fn cells(row: &Row) -> [String; 8] {
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| "–".into());
    [
        row.task.clone(),
        row.model.clone(),
        row.training.label().into(),
        format!("{}/{}", row.successes, row.trials),
        or_dash(row.rate.map(|rate| format!("{:.0} %", 100.0 * rate))),
        or_dash(row.interval.map(|(low, high)| format!("{:.0} to {:.0} %", 100.0 * low, 100.0 * high))),
        or_dash(row.mean_success_steps.map(|steps| format!("{steps:.0}"))),
        if row.errors > 0 { row.errors.to_string() } else { "–".into() },
    ]
}
