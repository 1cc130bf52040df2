//! Demonstration episodes.

use wire::Error;
use wire::demonstration::{DemonstrationStep, RecordedEpisode, digest};

/// Valid demonstration episode: its metadata, and T + 1 steps with T actions; the last frame is the goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    info: RecordedEpisode,
    steps: Vec<DemonstrationStep>,
}

impl Episode {
    /// Episode of these steps, in order and complete.
    ///
    /// # Errors
    /// If steps are missing or of another episode; frames differ in size or render spec; an action is missing, is one too
    /// many, has another width or is not in [-1, 1]; states differ in width; or the steps' digest is not that of `info`. The
    /// error names the step and field.
    pub fn new(info: RecordedEpisode, steps: Vec<DemonstrationStep>) -> Result<Self, Error> {
        check("steps", info.steps as usize, steps.len())?;
        let [first, .., last] = &steps[..] else {
            return Err(Error::invalid("steps", "at least 2", steps.len()));
        };

        for (number, step) in (0..).zip(&steps) {
            let fits = || {
                check("step", number, step.step)?;
                check("episode_id", &info.episode_id, &step.episode_id)?;
                check("frame", size(first), size(step))?;
                check("frame.render_spec", &*info.render_spec, step.frame.render_spec())?;
                check("state", values(&first.state), values(&step.state))?;
                check_actions(step, number == last.step, first.action.as_ref().map_or(0, Vec::len))
            };
            fits().map_err(|e| e.within(&format!("steps[{number}]")))?;
        }

        check("digest", &info.digest, &digest(&steps))?;
        Ok(Self { info, steps })
    }

    /// Metadata, as committed by the sender.
    pub fn info(&self) -> &RecordedEpisode {
        &self.info
    }

    /// Steps in order, at least 2.
    pub fn steps(&self) -> &[DemonstrationStep] {
        &self.steps
    }

    /// Steps in order, at least 2.
    pub fn into_steps(self) -> Vec<DemonstrationStep> {
        self.steps
    }
}

fn check<T: PartialEq + ToString>(field: &str, expected: T, got: T) -> Result<(), Error> {
    if expected == got { Ok(()) } else { Err(Error::invalid(field, expected, got)) }
}

fn check_actions(step: &DemonstrationStep, is_last: bool, width: usize) -> Result<(), Error> {
    if step.action.is_none() && !is_last {
        return Err(Error::invalid("action", "an action", "none"));
    }
    for (field, action) in [("action", &step.action), ("applied_action", &step.applied_action)] {
        let Some(action) = action else { continue };
        if is_last {
            return Err(Error::invalid(field, "none at the goal frame", "an action"));
        }
        check(field, format!("{width} values"), values(action))?;
        if let Some(value) = action.iter().find(|value| value.abs() > 1.0) {
            return Err(Error::invalid(field, "values in [-1, 1]", value));
        }
    }
    Ok(())
}

fn size(step: &DemonstrationStep) -> String {
    format!("{} x {}", step.frame.height(), step.frame.width())
}

fn values(values: &[f32]) -> String {
    format!("{} values", values.len())
}
