//! Samples of the outer loop.

use crate::engine::simd::element::Element;

/// Samples of a batch: embeddings and demonstrations.
#[derive(Debug, Clone, Copy)]
pub struct Samples<'a, T> {
    /// x, `[R, Z]`.
    pub x: &'a [T],
    /// x_g, `[R, Z]`.
    pub x_g: &'a [T],
    /// k, the scaled number of steps left, `[R]`.
    pub steps_left: &'a [T],
    /// Demonstrated actions, `[R, H, A]`.
    pub actions: &'a [T],
    /// Applied actions, `[R, H, A]`; empty without a dynamics loss.
    pub applied_actions: &'a [T],
    /// Mask, `[R, H]`: 1 for an action within the demonstration, else 0.
    pub mask: &'a [T],
    /// Embeddings of the frames after the demonstrated actions, `[R, H, Z]`; empty without a dynamics loss.
    pub next: &'a [T],
}

impl<'a, T: Element> Samples<'a, T> {
    /// Number of samples; `latent` is Z.
    pub fn rows(&self, latent: usize) -> usize {
        self.x.len() / latent
    }

    /// The `count` samples from `first` on; `latent` is Z.
    pub fn part(&self, latent: usize, first: usize, count: usize) -> Self {
        let rows = self.rows(latent);
        let cut = |values: &'a [T]| {
            let columns = values.len() / rows;
            &values[first * columns..(first + count) * columns]
        };
        Self {
            x: cut(self.x),
            x_g: cut(self.x_g),
            steps_left: cut(self.steps_left),
            actions: cut(self.actions),
            applied_actions: cut(self.applied_actions),
            mask: cut(self.mask),
            next: cut(self.next),
        }
    }
}
