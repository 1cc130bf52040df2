//! Camera frames as `foxglove.RawImage`.

use crate::file::check;
use foxglove::messages::{RawImage, Timestamp};
use prost::Message as _;
use wire::{Error, Image};

/// Pixel format, as [`RawImage`] names it.
const PIXELS: &str = "rgb8";
/// Name of the camera's frame of reference.
const FRAME_ID: &str = "camera";

/// Message of a frame at a time in nanoseconds since the start of the episode; the render spec is left out.
pub(crate) fn raw_image(frame: &Image, time: u64) -> RawImage {
    let seconds = u32::try_from(time / 1_000_000_000).unwrap_or(u32::MAX);
    RawImage {
        timestamp: Some(Timestamp::new(seconds, (time % 1_000_000_000) as u32)),
        frame_id: FRAME_ID.to_owned(),
        width: frame.width(),
        height: frame.height(),
        encoding: PIXELS.to_owned(),
        step: frame.width() * 3,
        data: frame.data().to_vec().into(),
    }
}

/// Frame in an encoded message, rendered as the episode's header says.
///
/// # Errors
/// If it is not a `RawImage` of tightly packed RGB8 pixels, or too large.
pub(crate) fn frame(bytes: &[u8], render_spec: &str) -> Result<Image, Error> {
    let image = RawImage::decode(bytes).map_err(|e| Error::invalid("payload", "foxglove.RawImage", e))?;
    check("encoding", PIXELS, &image.encoding)?;
    check("step", &image.width.saturating_mul(3).to_string(), &image.step.to_string())?;
    Image::new(image.height, image.width, image.data.into())?.rendered_as(render_spec)
}
