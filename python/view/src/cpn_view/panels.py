"""Images and plans, the same live and played."""

import numpy as np
import rerun as rr

from cpn.v1 import planner_pb2, types_pb2

ACTION_NAMES = ("x", "y", "z", "gripper")
"""Values of an action; those without a gripper have the first three."""
ACTION_COLORS = ((228, 87, 86), (84, 162, 75), (76, 120, 168), (157, 117, 93))
"""Colours of their series."""
RED, GREEN, BLUE, BROWN = ACTION_COLORS
MS_PER_SECOND = 1e3

PLAN_SERIES = {
    "inner_loss": rr.SeriesLines(names=["before the search", "of the plan"], colors=[BROWN, BLUE]),
    "latent_distance": rr.SeriesLines(names="latent distance", colors=RED),
    "times_ms": rr.SeriesLines(names=["queue", "encode", "plan"], colors=[BROWN, GREEN, BLUE]),
}
"""Series of a plan, by entity."""


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
        ValueError: If it is not RGB8, has no pixel, or has not as many bytes as its shape has.
    """
    if message.format != types_pb2.PIXEL_FORMAT_RGB8:
        raise ValueError(f"image.format: expected RGB8, got {message.format}")
    if not (message.height and message.width):
        raise ValueError(f"image: expected at least 1 x 1 pixel, got {message.height} x {message.width}")
    return image(message.data, message.height, message.width)


def plan(stream: rr.RecordingStream, origin: str, plan: planner_pb2.PlanResponse) -> None:
    """Logs losses, latent distance and times of a plan under the entity `origin`."""
    if plan.inner_losses:
        stream.log(f"{origin}/inner_loss", rr.Scalars([plan.inner_losses[0], plan.inner_losses[-1]]))
        stream.log(f"{origin}/inner_losses", rr.BarChart(plan.inner_losses, color=BLUE))
    if plan.HasField("latent_distance"):
        stream.log(f"{origin}/latent_distance", rr.Scalars(plan.latent_distance))
    times = (plan.times.queue_seconds, plan.times.encode_seconds, plan.times.plan_seconds)
    stream.log(f"{origin}/times_ms", rr.Scalars([MS_PER_SECOND * seconds for seconds in times]))
