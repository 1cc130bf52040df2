//! Dataset of a training run: all demonstrations in memory.

use crate::record::folder::{self, dataset_digest};
use crate::record::frame;
use anyhow::{Context, bail, ensure};
use cpn::method::Observed;
use cpn::{Frames, Input, images};
use rayon::prelude::*;
use recording::Episode as Recording;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use wire::Error;
use wire::demonstration::{DemonstrationStep, RecordedEpisode};

/// Frames and actions of all episodes that are not held out.
#[derive(Debug)]
pub struct Dataset {
    /// Frames in the order of the episodes. With positions, an episode's last frame is the recorded goal position, which is used
    /// only as a goal.
    frames: Frames,
    /// Actions in the order of the episodes, `[actions, A]`.
    actions: Vec<f32>,
    /// Applied actions: the same, or with noise added.
    applied_actions: Vec<f32>,
    action_size: usize,
    /// Standardised position of the hand in each frame; empty if a step has none.
    hand_positions: Vec<[f32; 3]>,
    episodes: Vec<Episode>,
    infos: Vec<RecordedEpisode>,
    digest: String,
}

/// Location of an episode in the dataset: T actions, and T + 1 frames before, between and after them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Episode {
    /// Index of the first frame in the dataset.
    pub first_frame: usize,
    /// Index of the first action in the dataset.
    pub first_action: usize,
    /// T, the number of actions.
    pub action_count: usize,
}

impl Dataset {
    /// Reads all episodes of `folder`, except those of the `held_out` tasks, as images or as positions.
    ///
    /// # Errors
    /// If a recording is damaged, or has no positions for an input of positions; two recordings have the same id; episodes differ
    /// in action size or render spec; no episode is left; or a held-out task has no episode, which is probably a misspelling.
    pub fn load(folder: &Path, held_out: &[String], input: Input) -> anyhow::Result<Self> {
        let all_tasks = folder::tasks(folder)?;
        for task in held_out {
            ensure!(all_tasks.contains(task), "hold_out: expected some of {all_tasks:?}, got {task:?}");
        }
        let held_out: Vec<_> = held_out.iter().map(|task| folder.join(task)).collect();
        let mut paths = folder::paths(folder)?;
        paths.retain(|path| !held_out.iter().any(|task| path.starts_with(task)));
        ensure!(!paths.is_empty(), "{}: expected demonstrations, got none", folder.display());
        if let Some(duplicate) = folder::duplicates(&paths).into_iter().next() {
            bail!(duplicate);
        }

        // Memory is allocated by the headers' sizes; then the episodes are read into it in parallel.
        let infos = paths.par_iter().map(|path| header(path)).collect::<anyhow::Result<Vec<_>>>()?;
        let (mut episodes, mut count) = (Vec::with_capacity(infos.len()), 0);
        for (path, info) in paths.iter().zip(&infos) {
            let (expected, got) = (&infos[0].render_spec, &info.render_spec);
            let path = path.display();
            ensure!(
                expected == got,
                "{path}: render_spec: expected {expected:?} like the episodes before, got {got:?}"
            );
            let action_count = info.steps as usize - 1;
            episodes.push(Episode { first_frame: count, first_action: count - episodes.len(), action_count });
            count += action_count + 1;
        }

        let (frames, read) = match input {
            Input::Image => {
                let mut pixels = vec![0; count * images::BYTES];
                let read = fill(slots(&mut pixels, images::BYTES, &episodes), folder, &paths, copy_pixels)?;
                (Frames::Images(pixels), read)
            }
            Input::Position => {
                let mut positions = vec![[0.0; 3]; count];
                let read = fill(slots(&mut positions, 1, &episodes), folder, &paths, copy_positions)?;
                (Frames::Positions(positions), read)
            }
        };

        let action_size = read[0].action_size;
        for (Steps { action_size: got, .. }, path) in read.iter().zip(&paths) {
            let path = path.display();
            ensure!(
                action_size == *got,
                "{path}: actions: expected {action_size} values like the episodes before, got {got}"
            );
        }
        let hand_positions = match &frames {
            Frames::Images(_) => {
                let read: Option<Vec<_>> = read.iter().map(|steps| steps.hand_positions.as_deref()).collect();
                read.unwrap_or_default().concat()
            }
            Frames::Positions(positions) => positions.clone(),
        };
        let hand_positions = standardised(hand_positions);
        let (actions, applied_actions): (Vec<_>, Vec<_>) =
            read.into_iter().map(|steps| (steps.actions, steps.applied_actions)).unzip();
        let (actions, applied_actions) = (actions.concat(), applied_actions.concat());
        let digest = dataset_digest(&infos);
        Ok(Self { frames, actions, applied_actions, action_size, hand_positions, episodes, infos, digest })
    }

    /// Names of the tasks, sorted.
    pub fn tasks(&self) -> BTreeSet<&str> {
        self.infos.iter().map(|info| info.variation.task.as_str()).collect()
    }

    /// Render spec of the frames; empty for images of a real camera and for positions.
    pub fn render_spec(&self) -> &str {
        match self.frames {
            Frames::Images(_) => &self.infos[0].render_spec,
            Frames::Positions(_) => "",
        }
    }

    /// The episodes, in the order of their files.
    pub fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    /// Number of frames with an action.
    pub fn sample_count(&self) -> usize {
        self.episodes.iter().map(|episode| episode.action_count).sum()
    }

    /// A, the size of an action.
    pub fn action_size(&self) -> usize {
        self.action_size
    }

    /// Digest of the episodes, by [`dataset_digest`].
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// Frames of all episodes.
    pub fn frames(&self) -> &Frames {
        &self.frames
    }

    /// Final goal of each episode.
    pub fn goals(&self) -> Vec<Observed<'_>> {
        let frames = self.frames.observed();
        self.episodes.iter().map(|episode| frames[episode.first_frame + episode.action_count]).collect()
    }

    /// Position of the hand in each frame, in the last of an episode of positions its goal, with mean 0 on each axis and standard
    /// deviation 1 over all axes; empty if a recorded step has no state of at least three values.
    pub fn hand_positions(&self) -> &[[f32; 3]] {
        &self.hand_positions
    }

    /// Actions, `[actions, A]`.
    pub fn actions(&self) -> &[f32] {
        &self.actions
    }

    /// Actions that were applied, `[actions, A]`: the same, or with noise added.
    pub fn applied_actions(&self) -> &[f32] {
        &self.applied_actions
    }
}

/// Actions and states of an episode's steps.
struct Steps {
    /// `[T, A]`.
    actions: Vec<f32>,
    /// `[T, A]`.
    applied_actions: Vec<f32>,
    /// A.
    action_size: usize,
    /// Position of the hand at each step, the first three values of its state.
    hand_positions: Option<Vec<[f32; 3]>>,
}

/// Positions less their mean, over the standard deviation of all their coordinates.
fn standardised(mut positions: Vec<[f32; 3]>) -> Vec<[f32; 3]> {
    let count = positions.len().max(1) as f64;
    for axis in 0..3 {
        let mean = positions.iter().map(|position| f64::from(position[axis])).sum::<f64>() / count;
        positions.iter_mut().for_each(|position| position[axis] -= mean as f32);
    }
    let squares = positions.as_flattened().iter().map(|value| f64::from(*value).powi(2)).sum::<f64>();
    let deviation = (squares / (3.0 * count)).sqrt().max(f64::from(f32::EPSILON)) as f32;
    positions.as_flattened_mut().iter_mut().for_each(|value| *value /= deviation);
    positions
}

fn header(path: &Path) -> anyhow::Result<RecordedEpisode> {
    let info = recording::read_header(path).with_context(|| path.display().to_string())?;
    ensure!(info.steps >= 2, "{}: steps: expected at least 2, got {}", path.display(), info.steps);
    Ok(info)
}

/// Divides the frames, of `size` values each, into one slice per episode.
fn slots<'a, T>(mut frames: &'a mut [T], size: usize, episodes: &[Episode]) -> Vec<&'a mut [T]> {
    let cut = |episode: &Episode| {
        let (slot, rest) = std::mem::take(&mut frames).split_at_mut((episode.action_count + 1) * size);
        frames = rest;
        slot
    };
    episodes.iter().map(cut).collect()
}

/// Reads the episodes and copies their frames into their slots by `copy`.
fn fill<T: Send>(
    slots: Vec<&mut [T]>,
    folder: &Path,
    paths: &[PathBuf],
    copy: impl Fn(&Recording, &mut [T]) -> anyhow::Result<()> + Sync,
) -> anyhow::Result<Vec<Steps>> {
    let read = |(slot, path): (&mut [T], &PathBuf)| {
        let episode = folder::read(folder, path)?;
        copy(&episode, slot).with_context(|| path.display().to_string())?;
        let actions: Vec<f32> = episode.steps().iter().flat_map(|step| step.action.iter().flatten()).copied().collect();
        let applied = |step: &DemonstrationStep| step.applied_action.clone().or_else(|| step.action.clone());
        let applied_actions = episode.steps().iter().filter_map(applied).flatten().collect();
        let action_size = actions.len() / (episode.steps().len() - 1);
        let hand_positions = episode.steps().iter().map(|step| step.state.first_chunk().copied()).collect();
        Ok(Steps { actions, applied_actions, action_size, hand_positions })
    };
    slots.into_par_iter().zip(paths).map(read).collect()
}

fn copy_pixels(episode: &Recording, slot: &mut [u8]) -> anyhow::Result<()> {
    check_count(slot.len() / images::BYTES, episode)?;
    for (image, step) in slot.chunks_exact_mut(images::BYTES).zip(episode.steps()) {
        frame::check(step)?;
        image.copy_from_slice(step.frame.data());
    }
    Ok(())
}

fn copy_positions(episode: &Recording, slot: &mut [[f32; 3]]) -> anyhow::Result<()> {
    check_count(slot.len(), episode)?;
    let position = |values: &[f32], field: String, expected| {
        values.first_chunk().copied().ok_or_else(|| Error::invalid(field, expected, values.len()))
    };
    for (target, step) in slot.iter_mut().zip(episode.steps()) {
        *target = position(&step.state, format!("steps[{}].state", step.step), "at least 3 values")?;
    }
    let goal = position(&episode.info().goal_position, "goal_position".into(), "3 values")?;
    slot[slot.len() - 1] = goal;
    Ok(())
}

fn check_count(expected: usize, episode: &Recording) -> anyhow::Result<()> {
    let got = episode.steps().len();
    ensure!(expected == got, "steps: expected {expected} as the header says, got {got}");
    Ok(())
}
