"""Images and series of actions, the same live and played."""

import numpy as np
import rerun as rr

from cpn.v1 import types_pb2

ACTION_NAMES = ("x", "y", "z", "gripper")
"""Values of an action; those without a gripper have the first three."""
ACTION_COLORS = ((228, 87, 86), (84, 162, 75), (76, 120, 168), (157, 117, 93))
"""Colours of their series."""


def image(data: bytes, height: int, width: int) -> rr.Image:
    """Image from RGB bytes, rows from the top.

    Raises:
        ValueError: If there are not height * width * 3 bytes.
    """
    if len(data) != height * width * 3:
        raise ValueError(f"image.data: expected {height} x {width} x 3 bytes, got {len(data)}")
    return rr.Image(np.frombuffer(data, np.uint8).reshape(height, width, 3))


def image_of(message: types_pb2.Image) -> rr.Image:
    """Image of a message.

    Raises:
        ValueError: If it is not RGB8, or has not as many bytes as its shape has.
    """
    if message.format != types_pb2.PIXEL_FORMAT_RGB8:
        raise ValueError(f"image.format: expected RGB8, got {message.format}")
    return image(message.data, message.height, message.width)
