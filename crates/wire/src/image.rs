//! Camera images.

use crate::{Error, proto};
use sha2::{Digest, Sha256};
use std::fmt;

/// Largest height and width, in pixels.
const MAX_SIDE: u32 = 512;
/// Longest render spec, in bytes.
const MAX_RENDER_SPEC_BYTES: usize = 1024;

/// RGB8 image, `[height, width, 3]` bytes: rows from the top, channels interleaved.
#[derive(Clone, PartialEq, Eq)]
pub struct Image {
    height: u32,
    width: u32,
    data: Vec<u8>,
    render_spec: String,
}

impl Image {
    /// Image of a real camera, from `height * width * 3` bytes.
    ///
    /// # Errors
    /// If a side is 0 or above 512 pixels, or the length of the data is not `height * width * 3`.
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
        Ok(Self { height, width, data, render_spec: String::new() })
    }

    /// The same image, rendered by a simulator with the configuration `spec`: JSON, opaque here; empty for a real camera.
    ///
    /// # Errors
    /// If the spec is longer than 1024 bytes.
    pub fn rendered_as(self, spec: impl Into<String>) -> Result<Self, Error> {
        Ok(Self { render_spec: render_spec("render_spec", spec.into())?, ..self })
    }

    /// Height in pixels.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Width in pixels.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Pixels, `height * width * 3` bytes.
    pub fn data(&self) -> &[u8] {
        &self.data
    }

    /// Configuration of camera and renderer, in JSON; empty for a real camera.
    pub fn render_spec(&self) -> &str {
        &self.render_spec
    }

    /// SHA-256 of format, shape, pixels and render spec, in hex: the goal id.
    pub fn digest(&self) -> String {
        let mut hasher = Sha256::new();
        hasher.update(b"rgb8");
        hasher.update(self.height.to_le_bytes());
        hasher.update(self.width.to_le_bytes());
        hasher.update(&self.data);
        hasher.update(&self.render_spec);
        hex::encode(hasher.finalize())
    }
}

/// Validates the length of a render spec.
pub(crate) fn render_spec(field: &str, spec: String) -> Result<String, Error> {
    if spec.len() <= MAX_RENDER_SPEC_BYTES {
        Ok(spec)
    } else {
        Err(Error::invalid(field, format!("at most {MAX_RENDER_SPEC_BYTES} bytes"), format!("{} bytes", spec.len())))
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
        Self::new(image.height, image.width, image.data)?.rendered_as(image.render_spec)
    }
}

impl From<Image> for proto::Image {
    fn from(image: Image) -> Self {
        let Image { height, width, data, render_spec } = image;
        Self { height, width, format: proto::PixelFormat::Rgb8.into(), data, render_spec }
    }
}
