//! Plot of a run's learning curve.

use crate::training::journal::Entry;
use crate::training::progress::Progress;
use anyhow::anyhow;
use plotters::coord::Shift;
use plotters::prelude::*;

/// Width and height of the plot, in pixels.
const SIZE: (u32, u32) = (960, 840);
/// Height of the loss's panel, in pixels, larger than the others.
const LOSS_HEIGHT: i32 = 400;
const TEXT: RGBColor = RGBColor(60, 64, 72);
const GRID: RGBColor = RGBColor(228, 230, 234);
const FONT: &str = "sans-serif";

/// Plot of one quantity against the step.
struct Panel {
    caption: &'static str,
    color: RGBColor,
    /// Maximum number of labels at the vertical axis.
    labels: usize,
    value: fn(&Progress) -> f64,
}

const PANELS: [Panel; 3] = [
    Panel { caption: "loss (running mean)", color: RGBColor(31, 99, 180), labels: 12, value: |progress| progress.loss },
    Panel {
        caption: "learning rate",
        color: RGBColor(196, 98, 16),
        labels: 5,
        value: |progress| progress.learning_rate,
    },
    Panel {
        caption: "samples a second",
        color: RGBColor(34, 130, 84),
        labels: 5,
        value: |progress| progress.samples_per_second,
    },
];

/// Plots loss, learning rate and throughput against the step, as an SVG document.
///
/// # Errors
/// If the plot cannot be drawn.
pub(crate) fn draw(name: &str, entries: &[Entry]) -> anyhow::Result<String> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        area.fill(&WHITE).map_err(|e| anyhow!("{e}"))?;
        let area =
            area.titled(&title(name, entries), (FONT, 20).into_font().color(&TEXT)).map_err(|e| anyhow!("{e}"))?;
        let (loss, others) = area.split_vertically(LOSS_HEIGHT);
        let areas = std::iter::once(loss).chain(others.split_evenly((2, 1)));
        for (panel, area) in PANELS.iter().zip(areas) {
            draw_panel(panel, &area, entries).map_err(|e| anyhow!("{e}"))?;
        }
        area.present().map_err(|e| anyhow!("{e}"))?;
    }
    Ok(svg)
}

fn title(name: &str, entries: &[Entry]) -> String {
    entries.last().map_or_else(
        || name.to_owned(),
        |entry| {
            let Progress { step, steps, epoch, epochs, loss, .. } = entry.progress;
            format!("{name}: step {step} of {steps}, epoch {epoch} of {epochs}, loss {loss:.4}")
        },
    )
}

fn draw_panel<B: DrawingBackend>(
    panel: &Panel,
    area: &DrawingArea<B, Shift>,
    entries: &[Entry],
) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
    let points = entries.iter().map(|entry| (entry.progress.step as f64, (panel.value)(&entry.progress)));
    let steps = entries.last().map_or(1.0, |entry| entry.progress.steps as f64);
    let highest = points.clone().map(|(_, value)| value).fold(f64::MIN_POSITIVE, f64::max);

    let mut chart = ChartBuilder::on(area)
        .margin(10)
        .margin_right(28)
        .caption(panel.caption, (FONT, 15).into_font().color(&TEXT))
        .x_label_area_size(26)
        .y_label_area_size(72)
        .build_cartesian_2d(0.0..steps, 0.0..highest * 1.05)?;
    chart
        .configure_mesh()
        .axis_style(TEXT)
        .bold_line_style(GRID)
        .light_line_style(TRANSPARENT)
        .label_style((FONT, 13).into_font().color(&TEXT))
        .x_labels(10)
        .y_labels(panel.labels)
        .x_label_formatter(&|step: &f64| format!("{step:.0}"))
        .y_label_formatter(&label)
        .draw()?;
    chart.draw_series(LineSeries::new(points, panel.color.stroke_width(2)))?;
    Ok(())
}

/// Label of a value at an axis.
fn label(value: &f64) -> String {
    match value.abs() {
        0.0 => "0".into(),
        size if size < 0.01 => format!("{value:.1e}"),
        size if size < 10.0 => format!("{value:.2}"),
        _ => format!("{value:.0}"),
    }
}
