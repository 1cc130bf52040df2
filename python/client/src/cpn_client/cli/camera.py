"""Frames of a webcam."""

# PyAV's stubs leave types out.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false

from itertools import islice

import PIL.Image

from cpn_client.errors import invalid

SKIPPED_FRAMES = 10
"""Frames before the one that is taken, while a webcam adapts its exposure."""


def grab(device: str) -> PIL.Image.Image:
    """Frame of a V4L2 webcam, in the webcam's own size.

    Args:
        device: Path of the device, for example `/dev/video0`, or its number.

    Raises:
        ValueError: If there is no such webcam, or it delivers no frame.
        ImportError: If the extra `camera` is not installed.
    """
    try:
        import av
        from av.error import FFmpegError
    except ModuleNotFoundError:
        raise ImportError("--camera: needs av: pip install 'cpn-client[camera]'") from None
    path = f"/dev/video{device}" if device.isdecimal() else device
    expected = "a V4L2 webcam, for example /dev/video0 or 0"
    try:
        with av.open(path, format="v4l2") as camera:
            frame = next(islice(camera.decode(video=0), SKIPPED_FRAMES, None), None)
    except FFmpegError as error:
        raise invalid("--camera", expected, error) from None
    if frame is None:
        raise invalid("--camera", expected, f"{path} without frames")
    return frame.to_image()
