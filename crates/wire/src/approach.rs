//! Approach of an episode, in plan requests and responses.

use crate::{Error, proto};

/// Largest absolute value in an approach's position, in standard deviations.
const MAX_POSITION: f32 = 1000.0;

/// Progress of an episode's hand through its targets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Approach {
    /// Number of targets that were reached or given up.
    pub tried: u32,
    /// Position of the hand when it last moved, standardised.
    pub position: [f32; 3],
    /// Number of plans since then.
    pub plans: u32,
}

impl TryFrom<proto::Approach> for Approach {
    type Error = Error;

    fn try_from(approach: proto::Approach) -> Result<Self, Error> {
        let proto::Approach { tried, position, plans } = approach;
        let Ok(position) = <[f32; 3]>::try_from(position.as_slice()) else {
            return Err(Error::invalid("position", "3 numbers", position.len()));
        };
        match position.iter().find(|value| value.is_nan() || value.abs() > MAX_POSITION) {
            Some(value) => {
                Err(Error::invalid("position", format!("numbers from -{MAX_POSITION} to {MAX_POSITION}"), value))
            }
            None => Ok(Self { tried, position, plans }),
        }
    }
}

impl From<Approach> for proto::Approach {
    fn from(Approach { tried, position, plans }: Approach) -> Self {
        Self { tried, position: position.to_vec(), plans }
    }
}
