//! What a model plans from and towards.

use crate::{Error, Image, proto};
use sha2::{Digest, Sha256};

/// Farthest that a position may lie from the origin along an axis.
const MAX_METRES: f32 = 1000.0;

/// A point in the world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Position([f32; 3]);

impl Position {
    /// x, y, z in metres.
    ///
    /// # Errors
    /// If one of them is not a number, or farther than 1 km.
    pub fn new(metres: [f32; 3]) -> Result<Self, Error> {
        for (field, value) in ["x", "y", "z"].into_iter().zip(metres) {
            // Written so that NaN, which compares false with everything, is refused too.
            if !(-MAX_METRES..=MAX_METRES).contains(&value) {
                return Err(Error::invalid(field, format!("-{MAX_METRES} to {MAX_METRES} metres"), value));
            }
        }
        Ok(Self(metres))
    }

    /// x, y, z in metres.
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

/// A picture, or where the hand is or is to go.
#[derive(Debug, Clone, PartialEq)]
pub enum Observation {
    /// What the camera shows.
    Image(Image),
    /// A position of the hand.
    Position(Position),
}

impl Observation {
    /// SHA-256 of everything in it, in hex: the id of a goal.
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

    /// How it was rendered; empty for what was not.
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
