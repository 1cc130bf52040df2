//! The demonstrations of a training run, in memory: every frame as bytes, side by side.

use crate::frame;
use crate::recordings::{self, dataset_digest};
use anyhow::{Context, ensure};
use cpn::images;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use wire::demonstration::RecordedEpisode;

/// Every frame and action of every episode that is not held out.
#[derive(Debug)]
pub struct Dataset {
    /// `[frames, 84, 84, 3]`, episode after episode.
    pixels: Vec<u8>,
    /// `[actions, A]`, likewise.
    actions: Vec<f32>,
    action_size: usize,
    episodes: Vec<Episode>,
    infos: Vec<RecordedEpisode>,
    digest: String,
}

/// Where an episode lies: T actions, and T + 1 frames before, between and after them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Episode {
    /// Its first frame among all.
    pub first_frame: usize,
    /// Its first action among all.
    pub first_action: usize,
    /// T.
    pub action_count: usize,
}

impl Dataset {
    /// Reads every episode of `folder` but those of the `held_out` tasks.
    ///
    /// # Errors
    /// If a recording is damaged, the episodes differ in the size of their actions or in how they were rendered, none is
    /// left, or a held-out task has none, which is more likely a slip of the pen than meant.
    pub fn load(folder: &Path, held_out: &[String]) -> anyhow::Result<Self> {
        let all_tasks = recordings::tasks(folder)?;
        for task in held_out {
            ensure!(all_tasks.contains(task), "hold_out: expected some of {all_tasks:?}, got {task:?}");
        }
        let held_out: Vec<_> = held_out.iter().map(|task| folder.join(task)).collect();
        let mut paths = recordings::paths(folder)?;
        paths.retain(|path| !held_out.iter().any(|task| path.starts_with(task)));
        ensure!(!paths.is_empty(), "{}: expected demonstrations, got none", folder.display());
        // The headers tell how much room everything takes; then each core fills in episodes.
        let infos = paths.par_iter().map(|path| header(path)).collect::<anyhow::Result<Vec<_>>>()?;
        let (mut episodes, mut frames) = (Vec::with_capacity(infos.len()), 0);
        for (path, info) in paths.iter().zip(&infos) {
            let (expected, got) = (&infos[0].render_spec, &info.render_spec);
            let path = path.display();
            ensure!(
                expected == got,
                "{path}: render_spec: expected {expected:?} like the episodes before, got {got:?}"
            );
            let action_count = info.steps as usize - 1;
            episodes.push(Episode { first_frame: frames, first_action: frames - episodes.len(), action_count });
            frames += action_count + 1;
        }
        let mut pixels = vec![0; frames * images::BYTES];
        let read = slots(&mut pixels, &episodes)
            .into_par_iter()
            .zip(&paths)
            .map(|(slot, path)| read(folder, path, slot).with_context(|| path.display().to_string()))
            .collect::<anyhow::Result<Vec<_>>>()?;
        let action_size = read[0].1;
        for ((_, got), path) in read.iter().zip(&paths) {
            let path = path.display();
            ensure!(
                action_size == *got,
                "{path}: actions: expected {action_size} values like the episodes before, got {got}"
            );
        }
        let actions = read.into_iter().flat_map(|(actions, _)| actions).collect();
        let digest = dataset_digest(&infos);
        Ok(Self { pixels, actions, action_size, episodes, infos, digest })
    }

    /// Names of the tasks, in order.
    pub fn tasks(&self) -> BTreeSet<&str> {
        self.infos.iter().map(|info| info.variation.task.as_str()).collect()
    }

    /// How every frame was rendered; empty for those of a real camera.
    pub fn render_spec(&self) -> &str {
        &self.infos[0].render_spec
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

    /// What [`dataset_digest`] gives for the episodes.
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// The bytes `[84, 84, 3]` of a frame.
    pub fn frame(&self, index: usize) -> &[u8] {
        &self.pixels[index * images::BYTES..][..images::BYTES]
    }

    /// The actions `[count, A]` from one on.
    pub fn actions(&self, first: usize, count: usize) -> &[f32] {
        &self.actions[first * self.action_size..][..count * self.action_size]
    }
}

fn header(path: &PathBuf) -> anyhow::Result<RecordedEpisode> {
    let info = recording::read_header(path).with_context(|| path.display().to_string())?;
    ensure!(info.steps >= 2, "{}: steps: expected at least 2, got {}", path.display(), info.steps);
    Ok(info)
}

/// Cuts the pixels into those of each episode.
fn slots<'a>(mut pixels: &'a mut [u8], episodes: &[Episode]) -> Vec<&'a mut [u8]> {
    let cut = |episode: &Episode| {
        let (slot, rest) = std::mem::take(&mut pixels).split_at_mut((episode.action_count + 1) * images::BYTES);
        pixels = rest;
        slot
    };
    episodes.iter().map(cut).collect()
}

/// Copies an episode's frames into their place; answers its actions `[T, A]` and A.
fn read(folder: &Path, path: &Path, slot: &mut [u8]) -> anyhow::Result<(Vec<f32>, usize)> {
    let episode = recordings::read(folder, path)?;
    let steps = episode.steps();
    let (expected, got) = (slot.len() / images::BYTES, steps.len());
    ensure!(expected == got, "steps: expected {expected} as the header says, got {got}");
    for (place, step) in slot.chunks_exact_mut(images::BYTES).zip(steps) {
        frame::check(step)?;
        place.copy_from_slice(step.frame.data());
    }
    let actions: Vec<f32> = steps.iter().flat_map(|step| step.action.iter().flatten()).copied().collect();
    let size = actions.len() / (steps.len() - 1);
    Ok((actions, size))
}
