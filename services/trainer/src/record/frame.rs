//! Requirements on frames of training data.

use cpn::images;
use wire::Error;
use wire::demonstration::DemonstrationStep;

/// Checks that a step's frame has the encoder's input size, 84 x 84 pixels.
///
/// # Errors
/// If it has another size; the error names the step.
pub fn check(DemonstrationStep { step, frame, .. }: &DemonstrationStep) -> Result<(), Error> {
    let side = images::SIZE as u32;
    if (frame.height(), frame.width()) == (side, side) {
        return Ok(());
    }
    let got = format!("{} x {}", frame.height(), frame.width());
    Err(Error::invalid(format!("steps[{step}].frame"), format!("{side} x {side}"), got))
}
