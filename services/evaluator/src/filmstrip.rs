//! Filmstrips for the report, from the recordings of trials.

use crate::record::{Folder, Trial};
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use wire::Image;

/// Frames of a strip, the first and the last of the episode among them.
pub(crate) const FRAMES: usize = 8;

/// Images of an episode as PNGs.
#[derive(Debug, Clone)]
pub(crate) struct Filmstrip {
    /// The goal.
    pub(crate) goal: Vec<u8>,
    /// Steps applied before each frame, and the frame.
    pub(crate) frames: Vec<(u32, Vec<u8>)>,
}

impl Filmstrip {
    /// The filmstrip of a trial.
    ///
    /// # Errors
    /// If the trial's recording cannot be read.
    pub(crate) fn of(trial: &Trial, folder: &Folder) -> anyhow::Result<Self> {
        let recording = folder.read_recording(trial)?;
        let frames = recording.frames();
        let frames = evenly_spaced(frames.len()).into_iter().map(|step| Ok((step as u32, png(&frames[step].image)?)));
        Ok(Self { goal: png(&recording.trial().goal)?, frames: frames.collect::<anyhow::Result<_>>()? })
    }
}

/// At most [`FRAMES`] of so many frames.
fn evenly_spaced(frames: usize) -> Vec<usize> {
    let last = frames - 1;
    let mut steps: Vec<_> = (0..FRAMES).map(|k| (k * last + (FRAMES - 1) / 2) / (FRAMES - 1)).collect();
    steps.dedup();
    steps
}

fn png(image: &Image) -> anyhow::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes).write_image(image.data(), image.width(), image.height(), ExtendedColorType::Rgb8)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_spread_from_the_first_to_the_last() {
        assert_eq!(evenly_spaced(151), [0, 21, 43, 64, 86, 107, 129, 150]);
        assert_eq!(evenly_spaced(3), [0, 1, 2]);
    }
}
