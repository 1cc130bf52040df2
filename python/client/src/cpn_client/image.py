"""Images and positions of requests, from the types that robots' programs have them in."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, cast, get_args

from cpn.v1 import types_pb2
from cpn_client.errors import invalid

if TYPE_CHECKING:
    import PIL.Image

SIZE = 84
"""Height and width of an image for a planner, in pixels."""
BYTES = SIZE * SIZE * 3

Resize: TypeAlias = Literal["pad", "crop"]


class SupportsArray(Protocol):
    """Array of NumPy, or convertible to one."""

    def __array__(self) -> Any: ...  # noqa: ANN401


ImageLike: TypeAlias = (
    "Image | bytes | bytearray | memoryview | str | os.PathLike[str] | SupportsArray | PIL.Image.Image"
)
Position: TypeAlias = "Sequence[float] | SupportsArray | types_pb2.Position"


@dataclass(frozen=True, repr=False)
class Image:
    """RGB image, 84 x 84 pixels.

    Raises:
        ValueError: If the data has another length.
    """

    data: bytes
    """[84, 84, 3], one byte each for red, green and blue, rows from the top."""
    render_spec: str = ""
    """Render spec of a simulator's image, in JSON; empty for a real camera's."""

    def __post_init__(self) -> None:
        if len(self.data) != BYTES:
            raise invalid("image", f"{BYTES} bytes, {SIZE} x {SIZE} x 3", f"{len(self.data)} bytes")

    @classmethod
    def of(cls, source: ImageLike, resize: Resize = "pad", field: str = "image") -> Image:
        """Image from an array or buffer, uint8 [height, width, 3], from 84 * 84 * 3 bytes, a file or a Pillow image.

        A file is turned upright by its EXIF orientation, a Pillow image is not. Another size than 84 x 84 is scaled
        with its aspect ratio kept: `"pad"` adds black bars to the shorter side, `"crop"` cuts the longer one at both
        ends. Checkpoints are trained on square images, without bars.

        Args:
            source: Image.
            resize: Treatment of images that are not square.
            field: Name of the image in errors.

        Raises:
            ValueError: If the array has another type or shape, or `resize` is another word.
            ImportError: If the image is a file or has to be scaled, and Pillow is not installed.
            OSError: If the file cannot be read, or is no image.
        """
        if resize not in get_args(Resize):
            raise invalid("resize", " or ".join(get_args(Resize)), repr(resize))
        if isinstance(source, Image):
            return source
        if isinstance(source, (bytes, bytearray)):
            return cls(bytes(source))
        if isinstance(source, (str, os.PathLike)):
            with _pillow().open(source) as file:
                return cls(_scaled(_upright(file), resize))
        if hasattr(source, "convert"):
            return cls(_scaled(source, resize))
        height, width, data = _pixels(source, field)
        if (height, width) == (SIZE, SIZE):
            return cls(data)
        return cls(_scaled(_pillow().frombytes("RGB", (width, height), data), resize))

    def to_proto(self) -> types_pb2.Image:
        """Message of the image."""
        image_format = types_pb2.PIXEL_FORMAT_RGB8
        return types_pb2.Image(
            height=SIZE, width=SIZE, format=image_format, data=self.data, render_spec=self.render_spec
        )


def image_or_position(value: ImageLike | Position, field: str) -> Image | types_pb2.Position:
    """Image, or position, x, y, z in metres, from a sequence or array of three numbers.

    Raises:
        ValueError: If it is neither, named by `field`.
    """
    if isinstance(value, types_pb2.Position):
        return value
    if isinstance(value, (str, bytes, bytearray, memoryview, Image)) or not hasattr(value, "__len__"):
        return Image.of(value, field=field)  # pyright: ignore[reportArgumentType]
    try:
        x, y, z = (float(number) for number in cast("Sequence[float]", value))
    except (TypeError, ValueError):
        if isinstance(value, Sequence):
            raise invalid(field, "an image or three numbers", value) from None
        return Image.of(value, field=field)
    return types_pb2.Position(x=x, y=y, z=z)


def _pixels(source: Any, field: str) -> tuple[int, int, bytes]:  # noqa: ANN401
    """Height, width and bytes of an array."""
    try:
        view = memoryview(source)
    except TypeError:
        if not hasattr(source, "__array__"):
            raise invalid(field, "an image", type(source).__name__) from None
        view = memoryview(source.__array__())
    shape = tuple(view.shape or ())
    if view.format != "B" or len(shape) != 3 or shape[2] != 3 or 0 in shape:
        raise invalid(field, "uint8 [height, width, 3]", f"format {view.format!r} {list(shape)}")
    return shape[0], shape[1], view.tobytes()


def _pillow() -> Any:  # noqa: ANN401
    try:
        import PIL.Image
    except ModuleNotFoundError:
        raise ImportError(
            f"image: expected {SIZE} x {SIZE} pixels without Pillow; for files and scaling: "
            "pip install 'cpn-client[image]'"
        ) from None
    return PIL.Image


def _upright(image: Any) -> Any:  # noqa: ANN401
    """Pillow image turned as its EXIF orientation says: phones store pictures as the sensor saw them."""
    from PIL import ImageOps

    return ImageOps.exif_transpose(image)


def _scaled(image: Any, resize: Resize) -> bytes:  # noqa: ANN401
    """Bytes of a Pillow image, scaled unless it has the size."""
    image = image.convert("RGB")
    if image.size != (SIZE, SIZE):
        from PIL import ImageOps

        scale = {"pad": ImageOps.pad, "crop": ImageOps.fit}[resize]
        image = scale(image, (SIZE, SIZE), _pillow().Resampling.BILINEAR)
    return image.tobytes()
