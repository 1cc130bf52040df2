"""Recordings of one's own demonstrations, for the trainer."""

from __future__ import annotations

import hashlib
import math
import operator
import os
import re
import struct
import tempfile
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from cpn.v1 import demonstration_pb2
from cpn_client.errors import invalid
from cpn_client.image import SIZE, Image, ImageLike, Resize

MAX_STEPS = 1000
MAX_ACTION = 32
"""Largest size of an action that a model has."""
MAX_STATE = 1024
MIN_CONTROL_HZ, MAX_CONTROL_HZ = 0.001, 10_000
CHUNK_BYTES = 4 << 20
"""Chunk size of a file: most episodes in one, since a frame compresses only against earlier ones of its chunk."""


def write_episode(
    folder: str | os.PathLike[str],
    *,
    task: str,
    seed: int,
    frames: Iterable[ImageLike],
    actions: Iterable[Iterable[float]],
    control_hz: float,
    states: Iterable[Iterable[float]] | None = None,
    success: bool = True,
    resize: Resize = "pad",
) -> Path:
    """Writes a demonstration as a recording, which appears whole; `cpn-trainer train --dataset FOLDER` trains on it.

    Args:
        folder: Folder of a dataset; the file is `FOLDER/TASK/TASK-SEED.mcap`.
        task: Name of the task: a-z, 0-9, '.', '_' and '-', with the seed at most 64 characters.
        seed: Number of the task's variation, each once, from 0 to 2^64 - 1.
        frames: Camera images, T + 1, with T from 1 to 999: one before each action, and the goal image, that of the
            finished task.
        actions: [T, A] in [-1, 1], with A from 1 to 32, the same in all episodes of a dataset.
        control_hz: Actions per second, 0.001 to 10000, the same in all episodes of a dataset.
        states: [T + 1, S], with S up to 1024 and the hand's x, y, z in metres first; no policy sees them.
        success: Whether the task is solved at the last frame; `cpn-trainer verify` reports an episode that is not.
        resize: Treatment of images that are not square, see `Image.of`; images of plans need the same.

    Returns:
        Path of the file.

    Raises:
        ValueError: If an argument is out of its range, frames and actions differ in their number, actions or states in
            their size, frames in their render spec, or a frame is no image.
        ImportError: If the extra `recordings` is not installed, or Pillow for frames that have to be scaled.
        FileExistsError: If the recording exists.
        BlockingIOError: If a trainer records to the folder.
        OSError: If the file cannot be written.
    """
    episode_id = f"{task}-{seed}"
    # Without a dot at the start: such files are passed over.
    if not re.fullmatch(r"[a-z0-9_-][a-z0-9._-]*", task) or len(episode_id) > 64:
        raise invalid("task", "a name of a-z, 0-9, '.', '_' and '-', with the seed at most 64 characters", repr(task))
    try:
        seed = operator.index(seed)
    except TypeError:
        raise invalid("seed", "an integer", repr(seed)) from None
    if not 0 <= seed < 2**64:
        raise invalid("seed", "0 to 2^64 - 1", seed)
    if not MIN_CONTROL_HZ <= control_hz <= MAX_CONTROL_HZ:
        raise invalid("control_hz", f"{MIN_CONTROL_HZ} to {MAX_CONTROL_HZ}", control_hz)
    steps = _steps(actions, states, success)
    images = _images(frames, len(steps), resize)
    header = demonstration_pb2.RecordedEpisode(
        episode_id=episode_id,
        variation={"task": task, "seed": seed},
        steps=len(steps),
        digest=_digest(images, steps),
        control_hz=control_hz,
        render_spec=images[0].render_spec,
    )
    path = Path(folder, task, f"{episode_id}.mcap")
    path.parent.mkdir(parents=True, exist_ok=True)
    with _beside_writers(Path(folder)), _appearing(path) as file:
        _write(file, header, images, steps)
    return path


def _steps(
    actions: Iterable[Iterable[float]], states: Iterable[Iterable[float]] | None, success: bool
) -> list[demonstration_pb2.RecordedStep]:
    steps: list[demonstration_pb2.RecordedStep] = []
    for number, values in enumerate(actions):
        action = _floats(values, f"actions[{number}]")
        steps.append(demonstration_pb2.RecordedStep(step=number, action={"values": action}))
        _check_action(steps[0].action.values, steps[-1].action.values, f"actions[{number}]")
    if not 1 <= len(steps) < MAX_STEPS:
        raise invalid("actions", f"1 to {MAX_STEPS - 1}", len(steps))
    steps.append(demonstration_pb2.RecordedStep(step=len(steps), success=success))
    if states is None:
        return steps
    rows = list(states)
    if len(rows) != len(steps):
        raise invalid("states", f"{len(steps)}, one more than actions", len(rows))
    for step, row in zip(steps, rows, strict=True):
        step.state.extend(_floats(row, f"states[{step.step}]"))
        _check_state(steps[0].state, step.state, f"states[{step.step}]")
    return steps


def _floats(values: Iterable[float], field: str) -> list[float]:
    try:
        return [float(value) for value in values]
    except (OverflowError, TypeError, ValueError):
        raise invalid(field, "a sequence of numbers", repr(values)) from None


def _check_action(first: Sequence[float], action: Sequence[float], field: str) -> None:
    if not 1 <= len(action) <= MAX_ACTION:
        raise invalid(field, f"1 to {MAX_ACTION} values", len(action))
    if len(action) != len(first):
        raise invalid(field, f"{len(first)} values as in actions[0]", len(action))
    # In this form NaN, which compares false with everything, is refused too.
    if not all(abs(value) <= 1 for value in action):
        raise invalid(field, "values in [-1, 1]", list(action))


def _check_state(first: Sequence[float], state: Sequence[float], field: str) -> None:
    if len(state) > MAX_STATE:
        raise invalid(field, f"at most {MAX_STATE} values", len(state))
    if len(state) != len(first):
        raise invalid(field, f"{len(first)} values as in states[0]", len(state))
    if not all(map(math.isfinite, state)):
        raise invalid(field, "finite numbers", list(state))


def _images(frames: Iterable[ImageLike], count: int, resize: Resize) -> list[Image]:
    images = [Image.of(frame, resize, f"frames[{number}]") for number, frame in enumerate(frames)]
    if len(images) != count:
        raise invalid("frames", f"{count}, one more than actions", len(images))
    for number, image in enumerate(images):
        if image.render_spec != images[0].render_spec:
            expected = f"{images[0].render_spec!r} as in frames[0]"
            raise invalid(f"frames[{number}].render_spec", expected, repr(image.render_spec))
    return images


def _digest(images: Sequence[Image], steps: Sequence[demonstration_pb2.RecordedStep]) -> str:
    """SHA-256 of the steps, in hex, as `RecordedEpisode.digest` in `proto/cpn/v1/demonstration.proto` defines it."""
    digest = hashlib.sha256()
    for image, step in zip(images, steps, strict=True):
        numbers = [*step.action.values, *step.state, step.reward]
        digest.update(image.data)
        digest.update(struct.pack(f"<{len(numbers)}f?", *numbers, step.success))
    return digest.hexdigest()


@contextmanager
def _beside_writers(folder: Path) -> Generator[None]:
    """Shared lock of a folder, which other writers of episodes may hold too, but no trainer."""
    # Not at the top, since the rest of the client also runs where this module is missing.
    import fcntl

    with (folder / ".lock").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError as error:
            reason = "expected a folder to which no trainer records"
            raise BlockingIOError(error.errno, reason, os.fspath(folder)) from None
        yield


@contextmanager
def _appearing(path: Path) -> Generator[IO[bytes]]:
    """File under a temporary name, which gets its own once it is written."""
    taken = FileExistsError(f"{path}: expected no recording of this task and seed, got one")
    if path.exists():
        raise taken
    # The trainer passes over names that begin so, and removes what killed processes leave of them.
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".unfinished-", suffix=path.suffix) as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
        os.chmod(file.name, 0o644)
        try:
            # A link, unlike a rename, fails if another process has written the recording meanwhile.
            os.link(file.name, path)
        except FileExistsError:
            raise taken from None


def _write(
    file: IO[bytes],
    header: demonstration_pb2.RecordedEpisode,
    images: Sequence[Image],
    steps: Sequence[demonstration_pb2.RecordedStep],
) -> None:
    try:
        from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
        from mcap_protobuf.writer import Writer
    except ModuleNotFoundError:
        raise ImportError("recording: needs mcap: pip install 'cpn-client[recordings]'") from None

    with Writer(file, chunk_size=CHUNK_BYTES) as writer:
        writer.write_message("/episode", header, log_time=0, publish_time=0)
        for step, image in zip(steps, images, strict=True):
            # As the reader rounds: halves up.
            nanos = math.floor(step.step * 1e9 / header.control_hz + 0.5)
            frame = RawImage(
                frame_id="camera", width=SIZE, height=SIZE, encoding="rgb8", step=3 * SIZE, data=image.data
            )
            frame.timestamp.FromNanoseconds(nanos)
            for topic, message in (("/camera", frame), ("/step", step)):
                writer.write_message(topic, message, log_time=nanos, publish_time=nanos, sequence=step.step)
