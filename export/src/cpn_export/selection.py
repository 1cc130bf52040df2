"""Chooses the recordings that make a dataset."""

from collections.abc import Sequence
from pathlib import Path

from cpn_export.error import ExportError
from cpn_export.recording import Header, read_header


def select_recordings(dataset: Path, tasks: Sequence[str] = (), episodes: int | None = None) -> list[Header]:
    """The recordings of `dataset` that go together, by task and seed.

    Args:
        dataset: Folder with a folder of recordings for each task.
        tasks: Which tasks, in this order; all of them if empty.
        episodes: How many of each task, lowest seeds first; all of them if None.

    Raises:
        ExportError: If a task is unknown, recordings are missing, or they differ in what a dataset has only one of.
    """
    if not dataset.is_dir():
        raise ExportError(f"dataset: expected a folder, got {dataset}")
    known = sorted(path.parent.name for path in dataset.glob("*/*.mcap"))
    known = list(dict.fromkeys(known))
    if not known:
        raise ExportError(f"dataset: expected recordings at {dataset}/<task>/*.mcap, got none")
    for task in tasks:
        if task not in known:
            raise ExportError(f"tasks: expected some of {', '.join(known)}, got {task}")
    chosen: list[Header] = []
    for task in dict.fromkeys(tasks or known):
        headers = sorted(
            (read_header(path) for path in (dataset / task).glob("*.mcap")), key=lambda header: header.seed
        )
        if episodes is not None and len(headers) < episodes:
            raise ExportError(f"episodes: expected {episodes} recordings of {task}, got {len(headers)}")
        chosen += headers[:episodes]
    _check_alike(chosen)
    return chosen


def _check_alike(headers: Sequence[Header]) -> None:
    first = headers[0]
    for header in headers:
        for field in ("control_hz", "render_spec"):
            expected, got = getattr(first, field), getattr(header, field)
            if expected != got:
                raise ExportError(f"{field}: expected {expected!r} as in {first.path}, got {got!r} in {header.path}")
    if not (first.control_hz > 0 and first.control_hz.is_integer()):
        raise ExportError(f"control_hz: expected a whole number, as LeRobot's fps, got {first.control_hz}")
