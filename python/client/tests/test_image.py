"""Images and positions, from the types that programs have them in."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import PIL.ExifTags
import PIL.Image
import pytest
from conftest import FRAME
from numpy.typing import NDArray

from cpn.v1 import types_pb2
from cpn_client import Image
from cpn_client.image import image_or_position


class Tensor:
    """Array without the buffer protocol, as torch's."""

    def __init__(self, array: NDArray[Any]) -> None:
        self._array = array

    def __array__(self) -> NDArray[Any]:
        return self._array


@pytest.fixture
def pixels() -> NDArray[np.uint8]:
    return np.asarray(PIL.Image.open(FRAME).convert("RGB"))


def test_every_type_is_the_same_image(pixels: NDArray[np.uint8]) -> None:
    flipped = np.ascontiguousarray(pixels[::-1])[::-1]
    data = pixels.tobytes()
    sources = [pixels, flipped, memoryview(pixels.data), Tensor(pixels), PIL.Image.fromarray(pixels), FRAME, str(FRAME)]
    for source in [*sources, data, bytearray(data), Image(data)]:
        assert Image.of(source) == Image(data)
    assert Image.of(PIL.Image.open(FRAME).convert("RGBA")) == Image(data)


@pytest.mark.parametrize(
    ("source", "got"),
    [
        (np.zeros((84, 84, 3), np.float32), "format 'f' [84, 84, 3]"),
        (np.zeros((3, 84, 84), np.uint8), "format 'B' [3, 84, 84]"),
        (np.zeros((84, 84, 4), np.uint8), "format 'B' [84, 84, 4]"),
        (np.zeros((84, 84), np.uint8), "format 'B' [84, 84]"),
        (np.zeros((0, 84, 3), np.uint8), "format 'B' [0, 84, 3]"),
    ],
)
def test_wrong_array_is_named(source: NDArray[Any], got: str) -> None:
    with pytest.raises(ValueError, match=r"^goal: expected uint8 \[height, width, 3\], got ") as error:
        Image.of(source, field="goal")
    assert str(error.value).endswith(got)


@pytest.mark.parametrize("source", [3, None, object()])
def test_no_image_is_named(source: Any) -> None:  # noqa: ANN401
    with pytest.raises(ValueError, match=f"^image: expected an image, got {type(source).__name__}$"):
        Image.of(source)


def test_bytes_of_another_size_are_refused() -> None:
    with pytest.raises(ValueError, match="image: expected 21168 bytes, 84 x 84 x 3, got 7 bytes"):
        Image.of(bytes(7))


def test_pad_keeps_all_and_crop_keeps_the_centre() -> None:
    wide = np.zeros((100, 200, 3), np.uint8)
    wide[:, :50], wide[:, 50:150], wide[:, 150:] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    padded, cropped = (
        np.frombuffer(image.data, np.uint8).reshape(84, 84, 3) for image in (Image.of(wide), Image.of(wide, "crop"))
    )
    # 42 rows of picture, between bars of 21 rows each.
    assert not padded[:20].any()
    assert not padded[-20:].any()
    assert padded[42, [5, 42, 78]].tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 255]]
    assert cropped[[0, 0, 42, 83], [1, 82, 42, 42]].tolist() == [[0, 255, 0]] * 4


def test_without_pillow_arrays_work_and_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, pixels: NDArray[np.uint8]
) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.delitem(sys.modules, "PIL.Image")
    assert Image.of(pixels).data == pixels.tobytes()
    for source in (FRAME, np.zeros((85, 84, 3), np.uint8)):
        with pytest.raises(ImportError, match=r"pip install 'cpn-client\[image\]'"):
            Image.of(source)


def test_picture_of_a_phone_is_turned_upright(tmp_path: Path, pixels: NDArray[np.uint8]) -> None:
    exif = PIL.Image.Exif()
    exif[PIL.ExifTags.Base.Orientation] = 6  # Stored a quarter turn to the left.
    PIL.Image.fromarray(np.rot90(pixels)).save(tmp_path / "goal.png", exif=exif)
    assert Image.of(tmp_path / "goal.png").data == pixels.tobytes()


def test_missing_file_is_pillows_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Image.of(tmp_path / "none.png")


def test_positions_are_three_numbers(pixels: NDArray[np.uint8]) -> None:
    for value in ((0.5, 1, -2), [0.5, 1.0, -2.0], np.array([0.5, 1, -2], np.float32)):
        assert image_or_position(value, "goal") == types_pb2.Position(x=0.5, y=1, z=-2)
    for value in (pixels, memoryview(pixels.data), pixels.tobytes(), FRAME, Image(pixels.tobytes())):
        assert image_or_position(value, "goal") == Image(pixels.tobytes())
    wrong: Any
    for wrong in ((1, 2), ("a", "b", "c")):
        with pytest.raises(ValueError, match=r"^goal: expected an image or three numbers, got "):
            image_or_position(wrong, "goal")
