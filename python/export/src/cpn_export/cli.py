"""Command line of the export."""

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
