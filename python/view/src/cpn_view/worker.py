"""Panel of a simulator worker: messages as entities under /workers/NAME."""

import math
from collections.abc import Sized

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cpn.v1 import sim_pb2
from cpn_view import panels

MIN_DEGREES, MAX_DEGREES = 0.1, 179.9
"""Range of a camera's field of view."""
MAX_HANDS = 64
"""Number of steps, the newest of the episode, whose plans can be drawn."""


def entity(worker: str, *names: str) -> str:
    """Path of an entity of a worker."""
    return rr.new_entity_path(["workers", worker, *names])


class Worker:
    """Entities of a worker: its episode, and the number of its episodes that were solved."""

    def __init__(self, stream: rr.RecordingStream, name: str) -> None:
        self._stream = stream
        self._name = name
        self._frame: sim_pb2.Frame | None = None
        self._drawn = True
        self._acting = ""
        """Id of the episode of the last action."""
        self._episodes, self._solved = 0, 0
        self._hands: dict[int, list[float]] = {}
        """Positions of the hand in the episode, by step."""

    def frame(self, frame: sim_pb2.Frame) -> None:
        """Takes a frame, which `draw` shows unless a later one comes before.

        Raises:
            ValueError: If a field is malformed.
        """
        _check(frame)
        starts = self._frame is None or frame.episode_id != self._frame.episode_id
        was_solved = not starts and self._frame is not None and self._frame.success
        if starts:
            self._start(frame)
        self._solved += frame.success and not was_solved
        self._frame, self._drawn = frame, False
        if frame.HasField("camera"):
            self._hands[frame.step] = list(frame.hand_position)
            if len(self._hands) > MAX_HANDS:
                del self._hands[next(iter(self._hands))]

    def action(self, message: sim_pb2.AppliedAction) -> None:
        """Shows an applied action."""
        if self._acting != message.episode_id:
            self._acting = message.episode_id
            # A gap between the lines of two episodes.
            self._log("action", rr.Clear(recursive=False))
        self._log("action", rr.Scalars(message.action.values))

    def plan(self, message: sim_pb2.TrialPlan) -> None:
        """Shows a plan, and the positions of the hand under it if its episode is the one shown.

        Raises:
            ValueError: If the actions differ in length, or have less than three values.
        """
        actions = np.array([action.values for action in message.plan.actions])
        if actions.ndim != 2 or actions.shape[1] < 3:
            raise ValueError(f"plan.actions: expected [H, A] with A at least 3, got {actions.shape}")
        panels.plan(self._stream, entity(self._name, "plan"), message.plan)

        frame, hand = self._frame, self._hands.get(message.step)
        if frame and hand and frame.episode_id == message.episode_id:
            path = planned_positions(hand, frame.control.metres, actions)
            self._log("path", rr.LineStrips3D([path], radii=rr.Radius.ui_points(1.5), colors=panels.GREEN))

    def draw(self) -> None:
        """Shows the latest frame, once."""
        frame = self._frame
        if frame is None or self._drawn:
            return
        self._drawn = True
        self._log("camera", panels.image_of(frame.image))
        self._log("progress", rr.Scalars(frame.progress))
        lines = [
            f"{frame.episode_id}, step {frame.step}",
            "solved" if frame.success else f"progress {frame.progress:.2f}",
            f"{self._solved} of {self._episodes} episodes solved so far",
        ]
        self._log("episode", rr.TextDocument("\n".join(lines)))

    def leave(self) -> None:
        """Says that the worker is gone."""
        self._log("episode", rr.TextDocument("The worker is gone."))

    def _start(self, frame: sim_pb2.Frame) -> None:
        """Starts an episode: its goal, and the camera's pose, which places positions in the image."""
        self._log("goal", panels.image_of(frame.goal) if frame.HasField("goal") else rr.Clear(recursive=False))
        self._log("camera", rr.Clear(recursive=False))
        self._episodes += 1
        self._hands.clear()
        self._log("path", rr.Clear(recursive=False))
        self._log("progress", rr.Clear(recursive=False))
        if not frame.HasField("camera"):
            return
        rotation = np.reshape(frame.camera.rotation, (3, 3))
        self._log("camera", rr.Transform3D(translation=frame.camera.position, mat3x3=rotation))
        width, height = frame.image.width, frame.image.height
        focal_pixels = height / 2 / math.tan(math.radians(frame.camera.field_of_view_degrees) / 2)
        axes = rr.ViewCoordinates.RUB
        self._log("camera", rr.Pinhole(focal_length=focal_pixels, width=width, height=height, camera_xyz=axes))

    def _log(self, name: str, contents: rr.AsComponents) -> None:
        self._stream.log(entity(self._name, name), contents)


def planned_positions(hand: list[float], metres: float, actions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions of the hand's set point under planned actions, [1 + H, 3] in metres.

    Args:
        hand: Position of the hand before the first action, [3] in metres.
        metres: Displacement of the set point by an action of 1, in metres.
        actions: [H, A], clipped to [-1, 1].
    """
    steps = metres * np.clip(actions[:, :3], -1, 1)
    return np.array(hand) + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _check(frame: sim_pb2.Frame) -> None:
    panels.image_of(frame.image)
    if frame.HasField("goal"):
        panels.image_of(frame.goal)
    if frame.HasField("camera"):
        _check_length("camera.position", frame.camera.position, 3)
        _check_length("camera.rotation", frame.camera.rotation, 9)
        _check_length("hand_position", frame.hand_position, 3)
        if not MIN_DEGREES <= frame.camera.field_of_view_degrees <= MAX_DEGREES:
            got = frame.camera.field_of_view_degrees
            raise ValueError(f"camera.field_of_view_degrees: expected {MIN_DEGREES} to {MAX_DEGREES}, got {got}")


def _check_length(field: str, values: Sized, expected: int) -> None:
    if len(values) != expected:
        raise ValueError(f"{field}: expected {expected} numbers, got {len(values)}")
