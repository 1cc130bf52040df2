"""Selection of the recordings of a dataset."""

from collections.abc import Callable, Sequence
from pathlib import Path

from cpn_export.error import ExportError
from cpn_export.recording import Header, read_header


def select_recordings(dataset: Path, tasks: Sequence[str] = (), episodes: int | None = None) -> list[Header]:
    """Selected recordings of `dataset`, ordered by task and seed.

    Args:
        dataset: Folder with a folder of recordings for each task.
        tasks: Tasks to select, in this order; all tasks if empty.
        episodes: Number of episodes per task, lowest seeds first; all episodes if None.

    Raises:
        ExportError: If a task is unknown, there are too few recordings, one is misplaced or duplicate, or they differ
            in control rate or render spec.
    """
    if not dataset.is_dir():
        raise ExportError(f"dataset: expected a folder, got {dataset}")
    known = [task for task in _names(dataset, Path.is_dir) if _paths(dataset / task)]
    if not known:
        raise ExportError(f"dataset: expected recordings at {dataset}/<task>/*.mcap, got none")
    for task in tasks:
        if task not in known:
            raise ExportError(f"tasks: expected some of {', '.join(known)}, got {task}")

    chosen: list[Header] = []
    for task in dict.fromkeys(tasks or known):
        headers = sorted(
            (_read_header(dataset, path) for path in _paths(dataset / task)), key=lambda header: header.seed
        )
        if episodes is not None and len(headers) < episodes:
            raise ExportError(f"episodes: expected {episodes} recordings of {task}, got {len(headers)}")
        chosen += headers[:episodes]

    _check_distinct(chosen)
    _check_alike(chosen)
    return chosen


def _paths(folder: Path) -> list[Path]:
    """Recordings in the folder of a task, ordered by name."""
    return [folder / name for name in _names(folder, lambda path: path.suffix == ".mcap")]


def _names(folder: Path, wanted: Callable[[Path], bool]) -> list[str]:
    """Names in a folder, ordered, without those that begin with a dot, which file systems and desktops leave behind."""
    try:
        return sorted(path.name for path in folder.iterdir() if not path.name.startswith(".") and wanted(path))
    except OSError as error:
        raise ExportError(f"{folder}: expected a folder that can be read, got {error.strerror}") from error


def _read_header(dataset: Path, path: Path) -> Header:
    """Reads the header of a recording, whose path must agree with it: a misplaced file is a copy of another's."""
    header = read_header(path)
    expected = dataset / header.task / f"{header.episode_id}.mcap"
    if path != expected:
        raise ExportError(f"{path}: place: expected {expected}, got {path}")
    return header


def _check_distinct(headers: Sequence[Header]) -> None:
    paths: dict[str, Path] = {}
    for header in headers:
        # Also by digest, since the same episode may have been copied under another id.
        for field in ("episode_id", "digest"):
            value = getattr(header, field)
            if (other := paths.setdefault(f"{field} {value}", header.path)) != header.path:
                raise ExportError(f"{header.path}: {field}: expected one that no other has, got {value} of {other}")


def _check_alike(headers: Sequence[Header]) -> None:
    first = headers[0]
    for header in headers:
        for field in ("control_hz", "render_spec"):
            expected, got = getattr(first, field), getattr(header, field)
            if expected != got:
                raise ExportError(f"{field}: expected {expected!r} as in {first.path}, got {got!r} in {header.path}")
    if not (first.control_hz > 0 and first.control_hz.is_integer()):
        raise ExportError(f"control_hz: expected a whole number, as LeRobot's fps, got {first.control_hz}")
