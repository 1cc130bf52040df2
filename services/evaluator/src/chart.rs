//! Layout of the report's drawings, in SVG user units.

use crate::filmstrip::FRAMES;
use crate::summary::{Row, Summary};
use serde::Serialize;

const WIDTH: f64 = 900.0;
/// Room for the tasks' names.
const LEFT: f64 = 170.0;
/// Room for the counts.
const RIGHT: f64 = 70.0;
const TOP: f64 = 8.0;
/// Room for the axis.
const BOTTOM: f64 = 44.0;
const BAR: f64 = 13.0;
const BAR_GAP: f64 = 3.0;
const GROUP_GAP: f64 = 18.0;
const STUB: f64 = 3.0;

/// Success rates as bars, grouped by task, with their intervals.
#[derive(Debug, Serialize)]
pub(crate) struct BarChart {
    width: f64,
    height: f64,
    /// Left end of the bars.
    left: f64,
    /// Right end of a bar of 100 %.
    right: f64,
    /// Lower end of the grid lines.
    bottom: f64,
    ticks: Vec<Tick>,
    groups: Vec<Group>,
}

#[derive(Debug, Serialize)]
struct Tick {
    x: f64,
    percent: u32,
}

#[derive(Debug, Serialize)]
struct Group {
    task: String,
    /// Middle of the group.
    y: f64,
    bars: Vec<Bar>,
}

#[derive(Debug, Serialize)]
struct Bar {
    /// Index of the model.
    model: usize,
    /// Tooltip of the bar.
    title: String,
    label: String,
    y: f64,
    /// Middle of the bar.
    middle: f64,
    height: f64,
    width: f64,
    /// Ends of the interval.
    whisker: Option<(f64, f64)>,
    /// Start of the label.
    label_x: f64,
}

impl BarChart {
    pub(crate) fn new(summary: &Summary) -> Self {
        let models = summary.run.models.len();
        let group_height = models as f64 * (BAR + BAR_GAP) - BAR_GAP;
        let groups: Vec<_> = summary
            .rows
            .chunks(models)
            .enumerate()
            .map(|(index, rows)| {
                let top = TOP + GROUP_GAP / 2.0 + index as f64 * (group_height + GROUP_GAP);
                let bars = rows
                    .iter()
                    .enumerate()
                    .map(|(model, row)| Bar::new(row, model, top + model as f64 * (BAR + BAR_GAP)));
                Group { task: rows[0].task.clone(), y: top + group_height / 2.0, bars: bars.collect() }
            })
            .collect();
        let bottom = TOP + groups.len() as f64 * (group_height + GROUP_GAP);
        let ticks = (0..=5).map(|k| Tick { x: x_of(f64::from(k) / 5.0), percent: 20 * k });
        Self {
            width: WIDTH,
            height: bottom + BOTTOM,
            left: LEFT,
            right: WIDTH - RIGHT,
            bottom,
            ticks: ticks.collect(),
            groups,
        }
    }
}

impl Bar {
    fn new(row: &Row, model: usize, y: f64) -> Self {
        let label = match row.rate {
            Some(_) => format!("{}/{}", row.successes, row.trials),
            None => "no result".into(),
        };
        let whisker = row.interval.map(|(low, high)| (x_of(low), x_of(high)));
        Self {
            model,
            title: format!("{}, {}: {label}", row.task, row.model),
            label,
            y,
            middle: y + BAR / 2.0,
            height: BAR,
            // A stub shows the colour where nothing succeeded.
            width: (x_of(row.rate.unwrap_or(0.0)) - LEFT).max(STUB),
            whisker,
            label_x: whisker.map_or(LEFT, |(_, high)| high) + 8.0,
        }
    }
}

fn x_of(rate: f64) -> f64 {
    LEFT + rate * (WIDTH - LEFT - RIGHT)
}

/// A value over the steps of an episode, drawn beneath the frames of its filmstrip: the step of a frame lies
/// under the frame.
#[derive(Debug, Serialize)]
pub(crate) struct Line {
    width: f64,
    height: f64,
    /// `x,y` pairs; a new line begins wherever a value is missing.
    lines: Vec<String>,
    first: f32,
    last: f32,
}

impl Line {
    const WIDTH: f64 = 800.0;
    const HEIGHT: f64 = 56.0;
    const PADDING: f64 = 4.0;

    /// None without any value. Each value stands beside its step; `frames` is the number of frames above, evenly spaced over the
    /// steps.
    pub(crate) fn new(values: &[(u32, Option<f32>)], steps: u32, frames: usize) -> Option<Self> {
        let known: Vec<f32> = values.iter().filter_map(|(_, value)| *value).collect();
        let (first, last) = (*known.first()?, *known.last()?);
        let greatest = known.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
        let frame_width = Self::WIDTH / FRAMES as f64;
        let point = |step: u32, value: f32| {
            let share = f64::from(step) / f64::from(steps.max(1));
            let x = frame_width * (0.5 + share * frames.saturating_sub(1) as f64);
            let y = Self::HEIGHT - Self::PADDING - f64::from(value / greatest) * (Self::HEIGHT - 2.0 * Self::PADDING);
            format!("{x:.1},{y:.1}")
        };
        let mut lines = vec![Vec::new()];
        for &(step, value) in values {
            match (value, lines.last_mut()) {
                (Some(value), Some(line)) => line.push(point(step, value)),
                _ => lines.push(Vec::new()),
            }
        }
        let lines = lines.iter().filter(|line| !line.is_empty()).map(|line| line.join(" ")).collect();
        Some(Self { width: Self::WIDTH, height: Self::HEIGHT, lines, first, last })
    }
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;

    #[test]
    fn a_line_ends_under_the_last_frame_and_breaks_at_a_gap() {
        let values = [(0, Some(4.0)), (1, Some(2.0)), (2, None), (3, Some(1.0)), (4, Some(0.0))];
        let line = Line::new(&values, 5, 6).unwrap();
        assert_eq!(line.lines, ["50.0,4.0 150.0,28.0", "350.0,40.0 450.0,52.0"]);
        assert_eq!((line.first, line.last), (4.0, 0.0));
        assert!(Line::new(&[(0, None)], 1, 2).is_none());
    }
}
