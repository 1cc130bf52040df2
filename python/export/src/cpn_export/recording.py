"""Reader of recordings: MCAP files of one episode each, as `proto/cpn/v1/demonstration.proto` describes them."""

import hashlib
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import NonSeekingReader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

from cpn_export.error import ExportError

MIN_STEPS = 2
"""Fewest steps of an episode: one with an action, and the goal frame."""

EPISODE, CAMERA, STEP = "/episode", "/camera", "/step"
SCHEMAS = {EPISODE: "cpn.v1.RecordedEpisode", CAMERA: "foxglove.RawImage", STEP: "cpn.v1.RecordedStep"}


@dataclass(frozen=True)
class Header:
    """Header of a recording: the metadata of its episode."""

    path: Path
    episode_id: str
    task: str
    seed: int
    render_spec: str
    """Render spec of the frames, in JSON."""
    goal_position: tuple[float, ...]
    """Goal position in metres; empty if the goal is no position."""
    steps: int
    """Number of steps T + 1, goal frame included."""
    digest: str
    """SHA-256 over the steps, in hex."""
    control_hz: float


@dataclass(frozen=True)
class Episode:
    """Episode of T + 1 steps; the last is the goal frame, without an action."""

    frames: NDArray[np.uint8]
    """[T + 1, height, width, 3], RGB, rows from the top."""
    actions: NDArray[np.float32]
    """[T, A]."""
    states: NDArray[np.float32]
    """[T + 1, S]."""
    rewards: NDArray[np.float32]
    """[T + 1], reward of the action before each step."""
    successes: NDArray[np.bool_]
    """[T + 1], whether the task is solved at each step."""


def read_header(path: Path) -> Header:
    """Reads only the header of a recording.

    Raises:
        ExportError: If the file is not a recording.
    """
    with _reading(path):
        for _, _, message in _messages(path, [EPISODE]):
            return Header(
                path=path,
                episode_id=message.episode_id,
                task=message.variation.task,
                seed=message.variation.seed,
                render_spec=message.render_spec,
                goal_position=tuple(message.goal_position),
                steps=message.steps,
                digest=message.digest,
                control_hz=message.control_hz,
            )
    raise ExportError(f"{path}: expected a message at {EPISODE}, got none")


def read_episode(header: Header) -> Episode:
    """Reads and checks the steps of the recording that `header` was read from.

    Raises:
        ExportError: If the file is corrupt, or its steps do not match the header.
    """
    path = header.path
    with _reading(path):
        messages: defaultdict[str, list[Any]] = defaultdict(list)
        times: defaultdict[str, list[int]] = defaultdict(list)
        for topic, log_time, message in _messages(path, [EPISODE, CAMERA, STEP]):
            messages[topic].append(message)
            times[topic].append(log_time)
        images, steps = messages[CAMERA], messages[STEP]

        _check(path, f"messages at {EPISODE}", 1, len(messages[EPISODE]))
        _check(path, "steps", header.steps, len(steps))
        _check(path, f"messages at {CAMERA}", header.steps, len(images))
        if len(steps) < MIN_STEPS:
            raise ExportError(f"{path}: steps: expected {MIN_STEPS} or more, got {len(steps)}")
        _check(path, f"times at {STEP}", [_log_time(number, header) for number in range(len(steps))], times[STEP])
        _check(path, f"times at {CAMERA}", times[STEP], times[CAMERA])
        _check(path, "numbers of the steps", list(range(len(steps))), [step.step for step in steps])
        _check(path, "actions", len(steps) - 1, sum(step.HasField("action") for step in steps))
        _check(path, "action of the goal frame", False, steps[-1].HasField("action"))
        for number, step in enumerate(steps):
            # In this form NaN, which compares false with everything, is refused too.
            if not all(abs(value) <= 1 for value in step.action.values):
                got = list(step.action.values)
                raise ExportError(f"{path}: action of step {number}: expected values in [-1, 1], got {got}")
        _check(path, "encodings of the frames", {"rgb8"}, {image.encoding for image in images})
        _check(path, "digest", header.digest, _digest(images, steps))
        return Episode(
            frames=np.stack([np.frombuffer(i.data, np.uint8).reshape(i.height, i.width, 3) for i in images]),
            actions=np.stack([np.array(step.action.values, np.float32) for step in steps[:-1]]),
            states=np.stack([np.array(step.state, np.float32) for step in steps]),
            rewards=np.array([step.reward for step in steps], np.float32),
            successes=np.array([step.success for step in steps], np.bool_),
        )


def _log_time(step: int, header: Header) -> int:
    """Time of a step, in nanoseconds since the start of the episode."""
    return math.floor(step * 1e9 / header.control_hz + 0.5)


def _digest(images: Sequence[Any], steps: Sequence[Any]) -> str:
    """SHA-256 of the steps, in hex, as `RecordedEpisode.digest` in `proto/cpn/v1/demonstration.proto` defines it."""
    digest = hashlib.sha256()
    for image, step in zip(images, steps, strict=True):
        digest.update(image.data)
        for values in (step.action.values, step.applied_action.values, step.state, [step.reward]):
            digest.update(np.array(values, "<f4").tobytes())
        digest.update(bytes([step.success]))
    return digest.hexdigest()


def _check(path: Path, what: str, expected: object, got: object) -> None:
    if expected != got:
        raise ExportError(f"{path}: {what}: expected {expected}, got {got}")


def _messages(path: Path, topics: Sequence[str]) -> Iterator[tuple[str, int, Any]]:
    """Topic, log time in nanoseconds and decoded content of each message at `topics`, in the order of the file."""
    with path.open("rb") as stream:
        # The seeking reader takes schemas from the file's summary, whose checksum it does not verify.
        reader = NonSeekingReader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages(topics=topics, log_time_order=False):
            _check(path, f"schema of {channel.topic}", SCHEMAS[channel.topic], schema.name if schema else None)
            yield channel.topic, message.log_time, decoded


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except ExportError:
        raise
    except Exception as error:  # A corrupt file raises errors of several layers: zstd, struct, ...
        raise ExportError(f"{path}: corrupt, or not a recording: {type(error).__name__}: {error}") from error
