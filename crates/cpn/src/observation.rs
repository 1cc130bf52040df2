//! Observations and goals: images or positions.

use crate::images;

/// An observation or a goal.
#[derive(Debug, Clone, Copy)]
pub enum Observed<'a> {
    /// RGB8, `[84, 84, 3]`.
    Image(&'a [u8]),
    /// x, y, z in metres.
    Position([f32; 3]),
}

/// F observations or goals of one kind.
#[derive(Debug, Clone, PartialEq)]
pub enum Frames {
    /// RGB8, `[F, 84, 84, 3]`.
    Images(Vec<u8>),
    /// x, y, z in metres, `[F, 3]`.
    Positions(Vec<[f32; 3]>),
}

impl Frames {
    /// The frames; bytes after the last complete image are ignored.
    pub fn observed(&self) -> Vec<Observed<'_>> {
        match self {
            Self::Images(bytes) => bytes.chunks_exact(images::BYTES).map(Observed::Image).collect(),
            Self::Positions(metres) => metres.iter().copied().map(Observed::Position).collect(),
        }
    }
}
