//! Camera images.

use crate::{Error, proto};
use sha2::{Digest, Sha256};
use std::fmt;

/// Largest height and width, in pixels.
const MAX_SIDE: u32 = 512;

/// An RGB8 image: rows from the top, red, green and blue interleaved.
#[derive(Clone, PartialEq, Eq)]
pub struct Image {
    height: u32,
    width: u32,
    data: Vec<u8>,
}

impl Image {
    /// An image of `height * width * 3` bytes.
    ///
    /// # Errors
    /// If a side is 0 or too large, or the data does not fit the sides.
    pub fn new(height: u32, width: u32, data: Vec<u8>) -> Result<Self, Error> {
        for (field, side) in [("height", height), ("width", width)] {
            if !(1..=MAX_SIDE).contains(&side) {
                return Err(Error::invalid(field, format!("1 to {MAX_SIDE} pixels"), side));
            }
        }
        let expected = height as usize * width as usize * 3;
        if data.len() != expected {
            return Err(Error::invalid("data", format!("{expected} bytes"), format!("{} bytes", data.len())));
        }
        Ok(Self { height, width, data })
    }

    /// Height in pixels.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Width in pixels.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// The pixels, `height * width * 3` bytes.
    pub fn data(&self) -> &[u8] {
        &self.data
    }

    /// SHA-256 of shape, format and pixels, in hex: the id of a goal.
    pub fn digest(&self) -> String {
        let mut hasher = Sha256::new();
        hasher.update(b"rgb8");
        hasher.update(self.height.to_le_bytes());
        hasher.update(self.width.to_le_bytes());
        hasher.update(&self.data);
        hex::encode(hasher.finalize())
    }
}

impl fmt::Debug for Image {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Image({} x {})", self.height, self.width)
    }
}

impl TryFrom<proto::Image> for Image {
    type Error = Error;

    fn try_from(image: proto::Image) -> Result<Self, Error> {
        if image.format() != proto::PixelFormat::Rgb8 {
            let got = proto::PixelFormat::try_from(image.format)
                .map_or_else(|_| image.format.to_string(), |format| format.as_str_name().to_owned());
            return Err(Error::invalid("format", proto::PixelFormat::Rgb8.as_str_name(), got));
        }
        Self::new(image.height, image.width, image.data)
    }
}

impl From<Image> for proto::Image {
    fn from(image: Image) -> Self {
        let Image { height, width, data } = image;
        Self { height, width, format: proto::PixelFormat::Rgb8.into(), data }
    }
}
