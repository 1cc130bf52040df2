//! What a frame must be to be trained on.

use cpn::images;
use wire::Error;
use wire::demonstration::DemonstrationStep;

/// Checks that a step's frame is of the one size that the method knows.
///
/// # Errors
/// If it is not, naming the step.
pub fn check(DemonstrationStep { step, frame, .. }: &DemonstrationStep) -> Result<(), Error> {
    let side = images::SIZE as u32;
    if (frame.height(), frame.width()) == (side, side) {
        return Ok(());
    }
    let got = format!("{} x {}", frame.height(), frame.width());
    Err(Error::invalid(format!("steps[{step}].frame"), format!("{side} x {side}"), got))
}
