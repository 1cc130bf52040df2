//! Batches of the outer loop.

use crate::observation::Frames;

/// Samples of a training step: B samples of F distinct frames.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    /// The distinct images or positions, F.
    pub frames: Frames,
    /// Index of each sample's observation among the frames, `[B]`.
    pub observations: Vec<usize>,
    /// Index of each sample's goal among the frames, `[B]`.
    pub goals: Vec<usize>,
    /// Number of steps from each sample's observation to its goal, `[B]`.
    pub steps_left: Vec<u32>,
    /// Demonstrated actions after the observation, `[B, H, A]`; 0 past the demonstration's end.
    pub actions: Vec<f32>,
    /// Actions that were applied, `[B, H, A]`: the demonstrated ones, or with noise added; empty without a dynamics loss.
    pub applied_actions: Vec<f32>,
    /// 1 for an action within the demonstration, else 0, `[B, H]`.
    pub mask: Vec<f32>,
    /// Index among the frames of the frame after each action within the demonstration, `[B, H]`, any past its end; empty without a
    /// dynamics loss.
    pub next: Vec<usize>,
    /// Standardised position of the hand in each frame, `[F][3]`; empty without a position loss.
    pub positions: Vec<[f32; 3]>,
}
