"""Import of a LeRobotDataset v3 as recordings."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.backward_compatibility import CompatibilityError
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from numpy.typing import NDArray
from tqdm import tqdm

from cpn_client import Image, write_episode
from cpn_client.image import Resize
from cpn_export.error import ExportError

SCALE = "action_scale.json"
"""File of the action scale in a folder of recordings."""
CHUNK_ROWS = 32
"""Rows read at once: a video is decoded in one go, of which all of an episode may not fit into memory."""


@dataclass(frozen=True)
class ActionScale:
    """Scale of actions from their range in a dataset to [-1, 1], for each of A dimensions."""

    min: NDArray[np.float64]
    """[A]."""
    max: NDArray[np.float64]
    """[A]."""

    def scaled(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """Action in [-1, 1], `2 (action - min) / (max - min) - 1`; -1 in a dimension that is constant."""
        span = self.max - self.min
        return 2 * (action - self.min) / np.where(span > 0, span, 1) - 1

    def write(self, folder: Path) -> None:
        """Writes the scale beside the recordings of a folder, which has one for all of them.

        Raises:
            ExportError: If the folder has another.
            OSError: If it cannot be written.
        """
        path = folder / SCALE
        text = json.dumps({"min": self.min.tolist(), "max": self.max.tolist()}, indent=2) + "\n"
        if path.exists() and path.read_text() != text:
            raise ExportError(f"out: expected a folder without recordings of another action scale, got {path}")
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def import_dataset(
    dataset: str, *, image_key: str, task: str, out: Path, resize: Resize = "pad", episodes: Sequence[int] = ()
) -> int:
    """Writes the episodes of a dataset as recordings of a task; returns their number.

    An episode of N rows becomes N frames and N - 1 actions: the last frame is the goal image. Its index in the dataset
    is the seed, `observation.state` the state, and `next.success` of the last row the success. Actions are scaled by
    the minimum and maximum of the whole dataset, which are written to `OUT/action_scale.json`.

    Args:
        dataset: Folder of the dataset, or its name on the Hugging Face Hub.
        image_key: Camera, a feature of images or video, for example `observation.images.front`.
        task: Name of the task.
        out: Folder of recordings.
        resize: Treatment of images that are not square, as `cpn_client.Image.of` has it.
        episodes: Indices of the episodes; all of them if empty.

    Raises:
        ExportError: If there is no such dataset, it lacks a feature or an episode, an episode is no demonstration, or
            recordings cannot be written, as those that exist.
    """
    source, indices = _open(dataset, image_key, episodes)
    stats = (source.meta.stats or {})["action"]
    scale = ActionScale(np.asarray(stats["min"], np.float64), np.asarray(stats["max"], np.float64))
    try:
        scale.write(out)
        first = 0
        for index in tqdm(indices, unit="episode"):
            rows = range(first, first + source.meta.episodes[index]["length"])
            episode = _episode(source, rows, image_key, resize, scale)
            try:
                write_episode(out, task=task, seed=index, control_hz=source.fps, **episode)
            except ValueError as error:
                raise ExportError(f"episode {index}: {error}") from error
            first = rows.stop
    except OSError as error:
        raise ExportError(f"out: expected room for new recordings, got {error}") from error
    return len(indices)


def _open(dataset: str, image_key: str, episodes: Sequence[int]) -> tuple[LeRobotDataset, list[int]]:
    """Dataset of some episodes, each row with the rows after it, and these episodes in the order of their rows."""
    root = Path(dataset) if Path(dataset).is_dir() else None
    if root and not (root / "meta" / "info.json").is_file():
        raise ExportError(f"dataset: expected a LeRobotDataset v3, got {dataset} without meta/info.json")
    name = "local/dataset" if root else dataset
    try:
        meta = LeRobotDatasetMetadata(name, root)
        _check_features(meta, image_key)
        count = meta.total_episodes
        if outside := [index for index in episodes if not 0 <= index < count]:
            raise ExportError(f"episodes: expected indices from 0 to {count - 1}, got {outside[0]}")
        indices = sorted(set(episodes)) or list(range(count))
        keys = {image_key, "action", "observation.state", "next.success"} & set(meta.features)
        ahead = {key: [row / meta.fps for row in range(CHUNK_ROWS)] for key in keys}
        # PyAV, since torchcodec is not installed.
        return LeRobotDataset(name, root, indices, delta_timestamps=ahead, video_backend="pyav"), indices
    except (CompatibilityError, OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ExportError(f"dataset: expected a LeRobotDataset v3, got {dataset}: {reason}") from error


def _check_features(meta: LeRobotDatasetMetadata, image_key: str) -> None:
    if image_key not in meta.camera_keys:
        raise ExportError(f"image-key: expected one of {', '.join(meta.camera_keys)}, got {image_key}")
    if "action" not in meta.features:
        raise ExportError(f"dataset: expected the feature action, got {', '.join(meta.features)}")


def _episode(
    dataset: LeRobotDataset, rows: range, image_key: str, resize: Resize, scale: ActionScale
) -> dict[str, Any]:
    """Frames, actions, states and success of an episode's rows."""
    render_spec = dataset.meta.info.get("render_spec", "")  # Of exported recordings.
    frames: list[Image] = []
    actions, states, success = [], [], True
    for start in rows[::CHUNK_ROWS]:
        count = min(CHUNK_ROWS, rows.stop - start)
        chunk = dataset[start]
        # LeRobot's images are [3, height, width] in [0, 1].
        pixels = (chunk[image_key][:count] * 255).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()
        frames += [Image(Image.of(image, resize).data, render_spec) for image in pixels]
        actions += [*scale.scaled(chunk["action"][:count].reshape(count, -1).numpy())]
        if "observation.state" in chunk:
            states += [*chunk["observation.state"][:count].reshape(count, -1)]
        if "next.success" in chunk:
            success = bool(chunk["next.success"][count - 1])
    return {"frames": frames, "actions": actions[:-1], "states": states or None, "success": success}
