"""Recordings of own demonstrations, as the trainer reads them."""

import fcntl
import os
import re
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import PROGRAMS, ROOT

from cpn_client import Image, recorded_goal, recorded_observation, write_episode

RANDOM = np.random.default_rng(0)
FRAMES = RANDOM.integers(0, 256, (5, 120, 160, 3), np.uint8)
ACTIONS = RANDOM.uniform(-1, 1, (4, 2)).astype(np.float32)
EPISODE: dict[str, Any] = {"task": "own", "seed": 3, "frames": FRAMES, "actions": ACTIONS, "control_hz": 30}


def write(folder: Path, **changes: Any) -> Path:  # noqa: ANN401
    return write_episode(folder, **EPISODE | changes)


def trainer(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([PROGRAMS / "cpn-trainer", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)


def test_recordings_pass_the_trainers_verification(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert path == tmp_path / "own/own-3.mcap"
    states = RANDOM.normal(size=(5, 4))
    write(tmp_path, seed=np.int64(4), frames=list(FRAMES), actions=ACTIONS.tolist(), success=np.True_, states=states)
    write(tmp_path, seed=2**64 - 1, actions=ACTIONS.astype(np.float64), resize="crop")
    report = trainer("verify", "--dataset", tmp_path)
    assert report.returncode == 0, report.stderr
    assert "3 episodes, dataset digest " in report.stdout


def test_an_episode_of_the_greatest_length_is_verified_and_an_unsolved_one_reported(tmp_path: Path) -> None:
    write(tmp_path, frames=[*FRAMES] * 200, actions=[[0.5] * 32] * 998 + [[-1] * 32])
    write(tmp_path, seed=5, success=False)
    report = trainer("verify", "--dataset", tmp_path)
    faults = [line for line in report.stdout.splitlines() if line.startswith("fault: ")]
    assert faults == ["fault: own/own-5.mcap: expected success at the last step, got none"]


@pytest.mark.parametrize("resize", ["pad", "crop"])
def test_frames_are_those_of_plans(tmp_path: Path, resize: Any) -> None:  # noqa: ANN401
    path = write(tmp_path, resize=resize)
    assert recorded_observation(path) == Image.of(FRAMES[0], resize)
    assert recorded_goal(path) == Image.of(FRAMES[-1], resize)


def test_render_spec_is_that_of_the_frames(tmp_path: Path) -> None:
    frames = [Image(Image.of(frame).data, "{}") for frame in FRAMES]
    assert recorded_goal(write(tmp_path, frames=frames)).render_spec == "{}"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"task": "Own"},
            "task: expected a name of a-z, 0-9, '.', '_' and '-', with the seed at most 64 .*, got 'Own'",
        ),
        ({"task": "../own"}, r"task: expected a name .*, got '\.\./own'"),
        ({"task": ".own"}, r"task: expected a name .*, got '\.own'"),
        ({"task": "o" * 63}, "task: expected a name .*, got 'ooo"),
        ({"seed": -1}, r"seed: expected 0 to 2\^64 - 1, got -1"),
        ({"seed": 2**64}, r"seed: expected 0 to 2\^64 - 1, got 18446744073709551616"),
        ({"seed": 1.0}, "seed: expected an integer, got 1.0"),
        ({"resize": "stretch"}, "resize: expected pad or crop, got 'stretch'"),
        ({"control_hz": 1e-300}, "control_hz: expected 0.001 to 10000, got 1e-300"),
        ({"actions": [[10**400]]}, r"actions\[0\]: expected a sequence of numbers, got \[1000"),
        ({"control_hz": 0}, "control_hz: expected 0.001 to 10000, got 0"),
        ({"control_hz": np.nan}, "control_hz: expected 0.001 to 10000, got nan"),
        ({"actions": []}, "actions: expected 1 to 999, got 0"),
        ({"actions": [[0]] * 1000}, "actions: expected 1 to 999, got 1000"),
        ({"actions": [[]]}, r"actions\[0\]: expected 1 to 32 values, got 0"),
        ({"actions": [[0] * 33]}, r"actions\[0\]: expected 1 to 32 values, got 33"),
        ({"actions": [[0, 0], [0]]}, r"actions\[1\]: expected 2 values as in actions\[0\], got 1"),
        ({"actions": [[0], [1.5]]}, r"actions\[1\]: expected values in \[-1, 1\], got \[1\.5\]"),
        ({"actions": [[np.nan]]}, r"actions\[0\]: expected values in \[-1, 1\], got \[nan\]"),
        ({"actions": [1, 0]}, r"actions\[0\]: expected a sequence of numbers, got 1"),
        ({"actions": ACTIONS[1:]}, "frames: expected 4, one more than actions, got 5"),
        ({"frames": FRAMES[1:]}, "frames: expected 5, one more than actions, got 4"),
        (
            {"frames": [*FRAMES[:4], FRAMES[4, 0]]},
            r"frames\[4\]: expected uint8 \[height, width, 3\], got .*\[160, 3\]",
        ),
        (
            {"frames": [*FRAMES[:4], Image(bytes(84 * 84 * 3), "{}")]},
            r"frames\[4\]\.render_spec: expected '' .* got '{}'",
        ),
        ({"states": np.zeros((4, 2))}, "states: expected 5, one more than actions, got 4"),
        ({"states": [[0]] * 4 + [[0, 0]]}, r"states\[4\]: expected 1 values as in states\[0\], got 2"),
        ({"states": np.zeros((5, 1025))}, r"states\[0\]: expected at most 1024 values, got 1025"),
        ({"states": [[np.inf]] * 5}, r"states\[0\]: expected finite numbers, got \[inf\]"),
    ],
)
def test_arguments_out_of_range_are_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        write(tmp_path / "data", **change)
    assert not (tmp_path / "data").exists()


def test_an_existing_recording_is_kept(tmp_path: Path) -> None:
    before = write(tmp_path).read_bytes()
    with pytest.raises(FileExistsError, match=r"own-3\.mcap: expected no recording of this task and seed, got one"):
        write(tmp_path, control_hz=10)
    assert (tmp_path / "own/own-3.mcap").read_bytes() == before


def test_one_of_two_writers_of_an_episode_writes_it(tmp_path: Path) -> None:
    def attempt(frames: Any) -> bool:  # noqa: ANN401
        try:
            write(tmp_path, frames=frames, actions=[[0.0]] * 400)
        except FileExistsError:
            return False
        return True

    noise = RANDOM.integers(0, 256, (2, 401, 84, 84, 3), np.uint8)
    with ThreadPoolExecutor() as pool:
        written = list(pool.map(attempt, noise))
    assert sorted(written) == [False, True]
    (path,) = tmp_path.glob("own/*")
    assert recorded_goal(path) == Image.of(noise[written.index(True), -1])


def test_an_interrupted_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write(tmp_path)
    assert list((tmp_path / "own").iterdir()) == []


def test_writers_share_a_folder_but_not_with_a_trainer(tmp_path: Path) -> None:
    with (tmp_path / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        write(tmp_path)
        # A second trainer, which wants the folder for itself.
        served = trainer("serve", "--dataset", tmp_path, "--listen", "tcp/127.0.0.1:0")
        assert re.search("expected one that no process keeps", served.stdout + served.stderr)
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(BlockingIOError, match="expected a folder to which no trainer records"):
            write(tmp_path, seed=4)
