"""Command lines of export and import."""

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import tyro

from cpn_export.error import ExportError
from cpn_export.selection import select_recordings


@dataclass(frozen=True)
class LeRobotConfig:
    """Write recorded demonstrations as a LeRobotDataset v3."""

    dataset: Path
    """Folder with a folder of recordings for each task."""
    out: Path
    """Folder to write; it must not exist yet."""
    tasks: tuple[str, ...] = ()
    """Tasks to export; all of them if none is named."""
    episodes: int | None = None
    """Episodes per task, lowest seeds first; all of them if not given."""

    def __post_init__(self) -> None:
        if self.episodes is not None and self.episodes < 1:
            raise ValueError(f"episodes: expected at least 1, got {self.episodes}")


@dataclass(frozen=True)
class ImportConfig:
    """Write the episodes of a LeRobotDataset v3 as recordings of a task."""

    dataset: str
    """Folder of the dataset, or its name on the Hugging Face Hub."""
    image_key: str
    """Camera, for example observation.images.front."""
    task: str
    """Name of the task."""
    out: Path
    """Folder of recordings."""
    crop: bool = False
    """Cut the longer side of images that are not square, in place of black bars at the shorter one."""
    episodes: tuple[int, ...] = ()
    """Indices of the episodes; all of them if none is given."""


def lerobot() -> None:
    """Runs `cpn-export-lerobot`."""
    config = tyro.cli(LeRobotConfig, prog="cpn-export-lerobot")
    warnings.filterwarnings("ignore", "Converting input from bool")  # LeRobot's statistics of next.success.
    try:
        recordings = select_recordings(config.dataset, config.tasks, config.episodes)
        # Imported late: it takes ten seconds, and wrong options should fail at once.
        from cpn_export.lerobot_dataset import write_dataset

        write_dataset(recordings, config.out)
    except ExportError as error:
        sys.exit(f"cpn-export-lerobot: {error}")
    frames = sum(recording.steps - 1 for recording in recordings)
    print(f"{config.out}: {len(recordings)} episodes, {frames} frames")


def import_lerobot() -> None:
    """Runs `cpn-import-lerobot`."""
    config = tyro.cli(ImportConfig, prog="cpn-import-lerobot")
    # Imported late, as above.
    from cpn_export.lerobot_import import import_dataset

    try:
        count = import_dataset(
            config.dataset,
            image_key=config.image_key,
            task=config.task,
            out=config.out,
            resize="crop" if config.crop else "pad",
            episodes=config.episodes,
        )
    except ExportError as error:
        sys.exit(f"cpn-import-lerobot: {error}")
    print(f"{config.out}: {count} recordings of {config.task}")
