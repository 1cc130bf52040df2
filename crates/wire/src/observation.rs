//! Observations and goals: camera images, or positions of the hand.

use crate::{Error, Image, proto};
use sha2::{Digest, Sha256};

/// Largest absolute coordinate of a position, in metres.
const MAX_METRES: f32 = 1000.0;

/// Position in the world frame, in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Position([f32; 3]);

impl Position {
    /// Position of the coordinates x, y, z in metres.
    ///
    /// # Errors
    /// If a coordinate is not a number, or beyond 1 km.
    pub fn new(metres: [f32; 3]) -> Result<Self, Error> {
        for (field, value) in ["x", "y", "z"].into_iter().zip(metres) {
            // In this form NaN, which compares false with everything, is refused too.
            if !(-MAX_METRES..=MAX_METRES).contains(&value) {
                return Err(Error::invalid(field, format!("-{MAX_METRES} to {MAX_METRES} metres"), value));
            }
        }
        Ok(Self(metres))
    }

    /// Coordinates x, y, z in metres.
    pub fn metres(self) -> [f32; 3] {
        self.0
    }
}

impl TryFrom<proto::Position> for Position {
    type Error = Error;

    fn try_from(proto::Position { x, y, z }: proto::Position) -> Result<Self, Error> {
        Self::new([x, y, z])
    }
}

impl From<Position> for proto::Position {
    fn from(Position([x, y, z]): Position) -> Self {
        Self { x, y, z }
    }
}

/// Observation, or goal, of a task.
#[derive(Debug, Clone, PartialEq)]
pub enum Observation {
    /// Camera image.
    Image(Image),
    /// Position of the hand.
    Position(Position),
}

impl Observation {
    /// SHA-256 of the contents, in hex: the goal id.
    pub fn digest(&self) -> String {
        match self {
            Self::Image(image) => image.digest(),
            Self::Position(Position(metres)) => {
                let mut hasher = Sha256::new();
                hasher.update(b"position");
                metres.iter().for_each(|value| hasher.update(value.to_le_bytes()));
                hex::encode(hasher.finalize())
            }
        }
    }

    /// Render spec of an image; empty for a real camera's image, and for a position.
    pub fn render_spec(&self) -> &str {
        match self {
            Self::Image(image) => image.render_spec(),
            Self::Position(_) => "",
        }
    }
}

impl From<Image> for Observation {
    fn from(image: Image) -> Self {
        Self::Image(image)
    }
}

impl From<Position> for Observation {
    fn from(position: Position) -> Self {
        Self::Position(position)
    }
}
