//! One demonstration.

use anyhow::{Context, ensure};
use cpn::archive::{self, Tensors};
use cpn::images;
use serde::{Deserialize, Serialize};
use std::path::Path;
use tch::{Kind, Tensor};
use wire::Error;
use wire::demonstration::{CommitEpisodeRequest, DemonstrationStep};

/// What is known of an episode besides its tensors.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeInfo {
    /// Its id in the stream.
    pub episode_id: String,
    /// Name of the task.
    pub task: String,
    /// What the object positions were drawn from.
    pub seed: u64,
}

/// Checks that a step's frame is of the one size that episodes have.
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
    /// What is known of it.
    pub info: EpisodeInfo,
    /// `[T + 1, 84, 84, 3]` bytes; the last frame is the goal.
    pub frames: Tensor,
    /// `[T, A]` floats in [-1, 1].
    pub actions: Tensor,
}

impl Episode {
    /// Puts the steps of a stream together. `steps` are in order and complete.
    ///
    /// # Errors
    /// Names the step and field that does not fit an episode.
    pub fn from_steps(commit: &CommitEpisodeRequest, steps: &[DemonstrationStep]) -> Result<Self, Error> {
        let (last, acting) = steps.split_last().ok_or_else(|| Error::invalid("steps", "at least 2", 0))?;
        let mut pixels = Vec::with_capacity(steps.len() * images::BYTES);
        for step in steps {
            check_frame(step)?;
            pixels.extend_from_slice(step.frame.data());
        }
        if last.action.is_some() {
            return Err(Error::invalid(format!("steps[{}].action", last.step), "none at the goal frame", "an action"));
        }
        let width = acting.first().and_then(|step| step.action.as_ref()).map_or(0, Vec::len);
        let mut actions = Vec::with_capacity(acting.len() * width);
        for DemonstrationStep { step, action, .. } in acting {
            let field = || format!("steps[{step}].action");
            let action = action.as_ref().ok_or_else(|| Error::invalid(field(), "an action", "none"))?;
            if action.len() != width {
                return Err(Error::invalid(field(), format!("{width} values"), action.len()));
            }
            if let Some(value) = action.iter().find(|value| value.abs() > 1.0) {
                return Err(Error::invalid(field(), "values in [-1, 1]", value));
            }
            actions.extend_from_slice(action);
        }
        let info = EpisodeInfo {
            episode_id: commit.episode_id.clone(),
            task: commit.variation.task.clone(),
            seed: commit.variation.seed,
        };
        let frames = images::from_bytes(&pixels).map_err(|e| Error::invalid("steps", "whole frames", e))?;
        Ok(Self { info, frames, actions: Tensor::from_slice(&actions).view([acting.len() as i64, width as i64]) })
    }

    /// T, the number of actions.
    pub fn action_count(&self) -> usize {
        self.actions.size()[0] as usize
    }

    /// The episode as the bytes of a file.
    ///
    /// # Errors
    /// If a tensor cannot be represented.
    pub fn to_bytes(&self) -> anyhow::Result<Vec<u8>> {
        let tensors = Tensors::from([
            ("frames".to_owned(), self.frames.shallow_clone()),
            ("actions".to_owned(), self.actions.shallow_clone()),
        ]);
        Ok(archive::to_bytes(&tensors, &self.info)?)
    }

    /// Reads an episode from the bytes of a file.
    ///
    /// # Errors
    /// If the file is damaged or its tensors do not fit together.
    pub fn from_bytes(bytes: &[u8]) -> anyhow::Result<Self> {
        let (mut tensors, info): (Tensors, EpisodeInfo) = archive::from_bytes(bytes)?;
        let mut take = |name: &str| tensors.remove(name).with_context(|| format!("tensor \"{name}\": none"));
        let (frames, actions) = (take("frames")?, take("actions")?);
        let [count, height, width, channels] = frames.size()[..] else {
            anyhow::bail!("frames: expected 4 dimensions, got {:?}", frames.size());
        };
        ensure!(
            frames.kind() == Kind::Uint8 && [height, width, channels] == [images::SIZE, images::SIZE, images::CHANNELS],
            "frames: expected Uint8[T + 1, 84, 84, 3], got {:?}{:?}",
            frames.kind(),
            frames.size()
        );
        let fits = actions.kind() == Kind::Float && actions.dim() == 2 && actions.size()[0] == count - 1 && count > 1;
        ensure!(fits, "actions: expected Float[{}, A], got {:?}{:?}", count - 1, actions.kind(), actions.size());
        Ok(Self { info, frames, actions })
    }

    /// Reads an episode's file.
    ///
    /// # Errors
    /// If it cannot be read, naming the file.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let read = || Self::from_bytes(&std::fs::read(path)?);
        read().with_context(|| format!("episode {}", path.display()))
    }
}
