//! Frames for the report: of each task and model the first success and the first failure, by seed.

use crate::record::{self, Folder, Outcome, Trial};
use anyhow::Context;
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use std::fs;
use std::path::PathBuf;
use wire::Image;

/// Frames of a strip, the first and the last of the episode among them.
pub(crate) const FRAMES: usize = 8;

/// A filmstrip as it is kept.
#[derive(Debug, Clone)]
pub(crate) struct Filmstrip {
    /// PNG of the goal image.
    pub(crate) goal: Vec<u8>,
    /// Steps applied before each frame, and its PNG.
    pub(crate) frames: Vec<(u32, Vec<u8>)>,
}

/// Keeps the frames of a trial unless those of an earlier seed with the same outcome are there. Strips that it makes
/// superfluous, later ones and those of other checkpoints, are removed.
pub(crate) fn keep(folder: &Folder, trial: &Trial, goal: &Image, frames: &[Image]) -> anyhow::Result<()> {
    let row = row(folder, trial);
    let name = name(trial);
    let (class, _) = name.split_at(name.len() - SEED_DIGITS);
    let outcome = class.split('-').next().unwrap_or_default();
    let strips = record::file_names(&row)?;
    if strips.iter().any(|strip| strip.starts_with(class) && *strip < name) {
        return Ok(());
    }
    // Written under a name that no reader looks for, then renamed: a strip is whole or absent.
    let unfinished = row.join("unfinished");
    let write = || {
        remove(&unfinished)?;
        fs::create_dir_all(&unfinished)?;
        fs::write(unfinished.join("goal.png"), png(goal)?)?;
        for step in evenly_spaced(frames.len()) {
            fs::write(unfinished.join(format!("{step:04}.png")), png(&frames[step])?)?;
        }
        for strip in strips.iter().filter(|strip| strip.starts_with(outcome)) {
            remove(&row.join(strip))?;
        }
        fs::rename(&unfinished, row.join(&name))?;
        anyhow::Ok(())
    };
    write().with_context(|| format!("keeping frames in {}", row.display()))
}

/// The filmstrip of a trial, if it was kept.
pub(crate) fn read(folder: &Folder, trial: &Trial) -> anyhow::Result<Option<Filmstrip>> {
    let path = row(folder, trial).join(name(trial));
    if !path.is_dir() {
        return Ok(None);
    }
    let read = || {
        let mut steps: Vec<(u32, String)> = record::file_names(&path)?
            .into_iter()
            .filter_map(|name| Some((name.strip_suffix(".png")?.parse().ok()?, name)))
            .collect();
        steps.sort();
        let goal = fs::read(path.join("goal.png"))?;
        let frames = steps.into_iter().map(|(step, name)| Ok((step, fs::read(path.join(name))?)));
        anyhow::Ok(Filmstrip { goal, frames: frames.collect::<anyhow::Result<_>>()? })
    };
    read().map(Some).with_context(|| format!("reading frames from {}", path.display()))
}

/// Digits of the seed in a strip's name, so that names order as seeds do.
const SEED_DIGITS: usize = 20;

fn row(folder: &Folder, trial: &Trial) -> PathBuf {
    folder.path("frames").join(&trial.task).join(&trial.model)
}

fn name(trial: &Trial) -> String {
    let outcome = match trial.outcome {
        Outcome::Success => "success",
        Outcome::Failure => "failure",
        Outcome::SolvedAtReset => "solved",
        Outcome::Error { .. } => "error",
    };
    let digest: String = trial.model_digest.chars().take(12).collect();
    format!("{outcome}-{digest}-{:0SEED_DIGITS$}", trial.seed)
}

fn remove(path: &std::path::Path) -> std::io::Result<()> {
    if path.is_dir() { fs::remove_dir_all(path) } else { Ok(()) }
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
#[expect(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;
    use crate::planning::Planning;
    use crate::record::{Episode, GoalSource, StageTimes};

    fn trial(seed: u64, digest: &str, outcome: Outcome) -> Trial {
        let episode = Episode {
            goal_id: "0".repeat(64),
            steps: 2,
            progress: vec![],
            plan_steps: vec![],
            latent_distances: vec![],
            first_inner_losses: vec![],
            last_inner_losses: vec![],
            mean_times: StageTimes::default(),
        };
        Trial {
            format: record::FORMAT,
            task: "reach".into(),
            seed,
            model: "cpn".into(),
            model_digest: digest.repeat(64),
            goal: GoalSource::SameVariation,
            planning: Planning::default(),
            outcome,
            episode: Some(episode),
        }
    }

    fn keep(folder: &Folder, trial: &Trial) {
        let image = Image::new(2, 2, vec![7; 12]).unwrap();
        super::keep(folder, trial, &image, &vec![image.clone(); 3]).unwrap();
    }

    #[test]
    fn the_first_seed_of_each_outcome_stays() {
        let root = tempfile::tempdir().unwrap();
        let folder = Folder::new(root.path());
        let trials = [
            trial(11, "a", Outcome::Success),
            trial(9, "a", Outcome::Failure),
            trial(10, "a", Outcome::Success),
            trial(12, "a", Outcome::Success),
        ];
        for trial in &trials {
            keep(&folder, trial);
        }
        let kept = trials.each_ref().map(|trial| read(&folder, trial).unwrap().is_some());
        assert_eq!(kept, [false, true, true, false]);
        let frames = read(&folder, &trials[1]).unwrap().unwrap().frames;
        assert_eq!(frames.iter().map(|(step, _)| *step).collect::<Vec<_>>(), [0, 1, 2]);
    }

    #[test]
    fn another_checkpoint_replaces_the_strips() {
        let root = tempfile::tempdir().unwrap();
        let folder = Folder::new(root.path());
        let (old, new) = (trial(1, "a", Outcome::Success), trial(5, "b", Outcome::Success));
        for trial in [&old, &new] {
            keep(&folder, trial);
        }
        assert!(read(&folder, &old).unwrap().is_none());
        assert!(read(&folder, &new).unwrap().is_some());
    }

    #[test]
    fn frames_are_spread_from_the_first_to_the_last() {
        assert_eq!(evenly_spaced(151), [0, 21, 43, 64, 86, 107, 129, 150]);
        assert_eq!(evenly_spaced(3), [0, 1, 2]);
    }
}
