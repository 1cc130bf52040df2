"""Images from the command line's arguments, and pictures in files."""

from collections.abc import Callable
from pathlib import Path

import PIL.Image
from PIL.PngImagePlugin import PngInfo

from cpn_client.errors import invalid
from cpn_client.image import SIZE, Image, Resize


def read(source: str, field: str, resize: Resize, recorded: Callable[[str], Image]) -> Image:
    """Image of 84 x 84 pixels from an image file, or from a recording.

    Args:
        source: Path of the file; of a recording if it ends in `.mcap`.
        field: Name of the argument in errors.
        resize: Treatment of images that are not square.
        recorded: Choice of the image in a recording.

    Raises:
        ValueError: If the file cannot be read, or is neither an image nor a recording with frames of 84 x 84 pixels.
    """
    try:
        return recorded(source) if source.endswith(".mcap") else Image.of(source, resize, field)
    except (OSError, ValueError, SyntaxError, PIL.Image.DecompressionBombError) as error:
        reason = str(getattr(error, "strerror", None) or error)
        got = reason if source in reason else f"{source}: {reason}"
        raise invalid(field, "an image file or a recording (.mcap)", got) from None


def picture(image: Image) -> PIL.Image.Image:
    """Pillow's form of an image."""
    return PIL.Image.frombytes("RGB", (SIZE, SIZE), image.data)


def write_png(path: Path, picture: PIL.Image.Image, field: str, **texts: str) -> None:
    """Writes a PNG file, with texts by keyword.

    Raises:
        ValueError: If the file cannot be written, named by `field`.
    """
    info = PngInfo()
    for keyword, text in texts.items():
        info.add_text(keyword, text)
    try:
        picture.save(path, "PNG", pnginfo=info)
    except OSError as error:
        raise invalid(field, "a file that can be written", error) from None
