"""Export of recordings as a LeRobotDataset v3."""

import io
import json
import os
import shutil
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import datasets
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import create_lerobot_dataset_card
from PIL import Image
from tqdm import tqdm

from cpn_export.error import ExportError
from cpn_export.recording import Episode, Header, read_episode
from cpn_export.workshop import workshop

ARM_STATE = ("hand_x", "hand_y", "hand_z", "gripper")
"""First values of the simulators' states."""

DESCRIPTION = """\
Demonstrations of a scripted expert. `goals/episode-*.png` are the pictures of the finished tasks, one an episode: the
last frame, which follows the last action and hence is no row. `meta/recordings.json` tells which recording each episode
was, its task, seed, goal position and digest; `render_spec` in `meta/info.json` how the frames were rendered."""


def write_dataset(recordings: Sequence[Header], out: Path) -> None:
    """Writes `recordings`, at least one, as a dataset at `out`, atomically.

    Raises:
        ExportError: If `out` exists or cannot be written, or a recording is faulty or differs in sizes from the first.
    """
    if os.path.lexists(out):
        raise ExportError(f"out: expected a path where nothing is yet, got {out}")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with workshop(out) as folder:
            partial = folder / out.name
            _write(recordings, partial)
            # Checked again, since the rename would silently replace an empty folder created meanwhile.
            if os.path.lexists(out):
                raise ExportError(f"out: expected a path where nothing is yet, got {out}")
            partial.rename(out)
    except OSError as error:
        # The system's text, since libraries word the same error differently.
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise ExportError(f"out: expected room for a dataset at {out}, got {reason}") from error


def features(episode: Episode) -> dict[str, dict[str, Any]]:
    """LeRobot features of a dataset of episodes with the shapes of this one."""
    height, width, channels = episode.frames.shape[1:]
    return {
        # PNG instead of video: lossless, and at 84 x 84 small enough.
        "observation.image": {
            "dtype": "image",
            "shape": (height, width, channels),
            "names": ["height", "width", "channels"],
        },
        "observation.state": {"dtype": "float32", "shape": (len(ARM_STATE),), "names": list(ARM_STATE)},
        "observation.environment_state": {"dtype": "float32", "shape": episode.states.shape[1:], "names": None},
        "action": {"dtype": "float32", "shape": episode.actions.shape[1:], "names": None},
        "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    }


def _write(recordings: Sequence[Header], root: Path) -> None:
    datasets.disable_progress_bars()  # One per episode, besides the bar of all episodes.
    dataset = _create(recordings[0], root)
    provenance: list[dict[str, Any]] = []

    try:
        for index, header in enumerate(tqdm(recordings, unit="episode")):
            episode = read_episode(header)
            try:
                _add(dataset, header, episode)
            except ValueError as error:
                raise ExportError(f"{header.path}: expected the sizes of {recordings[0].path}: {error}") from error
            dataset.save_episode()
            goal = Path("goals", f"episode-{index:06d}.png")
            Image.fromarray(episode.frames[-1]).save(root / goal)
            provenance.append(_provenance(index, header, goal))
    finally:
        dataset.finalize()  # Even after an error: its destructor would do so, and write files again.

    shutil.rmtree(root / "images", ignore_errors=True)  # LeRobot's frames before they are in a Parquet file.
    (root / "meta" / "recordings.json").write_text(json.dumps(provenance, indent=2) + "\n")
    card = create_lerobot_dataset_card(dataset_info=dataset.meta.info, dataset_description=DESCRIPTION)
    card.save(root / "README.md")


def _create(first: Header, root: Path) -> LeRobotDataset:
    episode = read_episode(first)
    if episode.states.shape[1] < len(ARM_STATE):
        raise ExportError(
            f"{first.path}: state: expected {len(ARM_STATE)} values or more, got {episode.states.shape[1]}"
        )
    dataset = LeRobotDataset.create(
        repo_id=root.stem,
        root=root,
        fps=int(first.control_hz),
        features=features(episode),
        use_videos=False,
        video_backend="pyav",  # Unused, but without it LeRobot warns that torchcodec is missing.
    )
    dataset.meta.info["render_spec"] = first.render_spec
    (root / "goals").mkdir()
    return dataset


def _add(dataset: LeRobotDataset, header: Header, episode: Episode) -> None:
    """Adds the T rows of an episode; reward and success of row t are those of the recording's step t + 1."""
    for t, action in enumerate(episode.actions):
        row = {
            "observation.image": episode.frames[t],
            "observation.state": episode.states[t, : len(ARM_STATE)],
            "observation.environment_state": episode.states[t],
            "action": action,
            "next.reward": episode.rewards[t + 1, np.newaxis],
            "next.success": episode.successes[t + 1, np.newaxis],
            "task": header.task,
        }
        # LeRobot only prints an error of writing an image, and continues.
        with redirect_stdout(io.StringIO()) as printed:
            dataset.add_frame(row)
        if not Path((dataset.episode_buffer or {})["observation.image"][t]).exists():
            raise OSError(printed.getvalue().strip())


def _provenance(index: int, header: Header, goal: Path) -> dict[str, Any]:
    return {
        "episode_index": index,
        "episode_id": header.episode_id,
        "task": header.task,
        "seed": header.seed,
        "goal_position": header.goal_position,
        "digest": header.digest,
        "goal_image": str(goal),
    }
