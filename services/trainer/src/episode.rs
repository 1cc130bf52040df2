//! One demonstration, as training sees it.

use cpn::images;
use tch::Tensor;
use wire::Error;
use wire::demonstration::DemonstrationStep;

/// Checks that a step's frame is of the one size that the method knows.
///
/// # Errors
/// If it is not, naming the step.
pub fn check_frame(DemonstrationStep { step, frame, .. }: &DemonstrationStep) -> Result<(), Error> {
    let side = images::SIZE as u32;
    if (frame.height(), frame.width()) == (side, side) {
        return Ok(());
    }
    let got = format!("{} x {}", frame.height(), frame.width());
    Err(Error::invalid(format!("steps[{step}].frame"), format!("{side} x {side}"), got))
}

/// T expert actions with the frames before, between and after them.
#[derive(Debug)]
pub struct Episode {
    /// `[T + 1, 84, 84, 3]` bytes; the last frame is the goal.
    pub frames: Tensor,
    /// `[T, A]` floats in [-1, 1].
    pub actions: Tensor,
}

impl Episode {
    /// The tensors of a recording.
    ///
    /// # Errors
    /// If its frames are not 84 x 84.
    pub fn from_recording(recording: &recording::Episode) -> Result<Self, Error> {
        let steps = recording.steps();
        steps.iter().try_for_each(check_frame)?;
        let pixels: Vec<u8> = steps.iter().flat_map(|step| step.frame.data()).copied().collect();
        let frames = images::from_bytes(&pixels).map_err(|e| Error::invalid("steps", "whole frames", e))?;
        let actions: Vec<f32> = steps.iter().flat_map(|step| step.action.iter().flatten()).copied().collect();
        Ok(Self { frames, actions: Tensor::from_slice(&actions).view([steps.len() as i64 - 1, -1]) })
    }

    /// T, the number of actions.
    pub fn action_count(&self) -> usize {
        self.actions.size()[0] as usize
    }
}
