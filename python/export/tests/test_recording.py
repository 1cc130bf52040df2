import json
from pathlib import Path

import numpy as np
import pytest

from cpn_export.error import ExportError
from cpn_export.recording import read_episode, read_header
from tests.support import SIZE, Sample

GOLDEN = Path(__file__).resolve().parents[3] / "tests" / "golden" / "episode_digest.json"


def read(path: Path) -> None:
    read_episode(read_header(path))


@pytest.mark.parametrize("part", ["nothing", "half", "all but the end"])
def test_a_truncated_file_is_named(tmp_path: Path, part: str) -> None:
    path = Sample("reach", 1).write(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: {"nothing": 0, "half": len(whole) // 2, "all but the end": -1}[part]])
    with pytest.raises(ExportError, match=r"reach-1\.mcap: corrupt, or not a recording"):
        read(path)


def test_a_flipped_byte_is_noticed(tmp_path: Path) -> None:
    path = Sample("reach", 1).write(tmp_path)
    whole = path.read_bytes()
    # Up to the end of the only chunk; after it there are only indices, which are not used.
    for position in range(0, whole.rindex(Sample("reach", 1).frames[-1].tobytes()[-64:]), 997):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0xFF]) + whole[position + 1 :])
        with pytest.raises(ExportError, match=r"reach-1\.mcap"):
            read(path)


@pytest.mark.parametrize(
    ("sample", "message"),
    [
        (Sample("reach", 1, steps=7), "steps: expected 7, got 6"),
        (Sample("reach", 1, last_action=True), "actions: expected 5, got 6"),
        (Sample("reach", 1, digest="00ff"), "digest: expected 00ff, got [0-9a-f]{64}"),
        (Sample("reach", 1, length=0), "steps: expected 2 or more, got 1"),
        (Sample("reach", 1, action_scale=9), r"action of step \d: expected values in \[-1, 1\], got \["),
        (Sample("reach", 1, action_scale=np.nan), r"action of step 0: expected values in \[-1, 1\], got \[nan"),
        (Sample("reach", 1, step_hz=40), r"times at /step: expected \[0, 12500000, .*, got \[0, 25000000, "),
    ],
)
def test_steps_that_do_not_match_the_header_are_refused(tmp_path: Path, sample: Sample, message: str) -> None:
    with pytest.raises(ExportError, match=rf"reach-1\.mcap: {message}"):
        read(sample.write(tmp_path))


def test_the_digest_matches_the_golden_one(tmp_path: Path) -> None:
    sample = Sample("golden", 0, length=2, state_size=2, digest=json.loads(GOLDEN.read_text())["digest"])
    numbers = np.arange(3, dtype=np.float32)
    pixels = 7 * np.arange(SIZE * SIZE * 3) + 13 * np.arange(3)[:, np.newaxis]
    sample.frames = (pixels % 256).astype(np.uint8).reshape(3, SIZE, SIZE, 3)
    sample.actions = np.array([[0.5, -0.25, n, 1] for n in range(2)], np.float32)
    sample.states = np.stack([numbers + 0.5, np.full_like(numbers, -1)], axis=1)
    sample.rewards = numbers * np.float32(0.125)
    sample.successes = numbers == 2
    read(sample.write(tmp_path))
