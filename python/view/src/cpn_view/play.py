"""Player of recordings, MCAP files of one trial or demonstration each."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from mcap.reader import NonSeekingReader
from mcap_protobuf.decoder import DecoderFactory

from cpn_view.error import ViewError
from cpn_view.recorded import KINDS, Kind

OpenStream = Callable[[str, str], AbstractContextManager[rr.RecordingStream]]
"""Function that opens a stream of an application, with the identifier of its recording."""


@dataclass(frozen=True)
class Entry:
    """Message of a recording."""

    schema: str
    """Name of its type."""
    step: int
    """Number of actions applied before."""
    time: int
    """Log time, in nanoseconds since the start of the episode."""
    message: Any


def find_recordings(paths: Iterable[Path]) -> list[Path]:
    """Recordings at the paths, those of a folder sorted by path. Names that begin with a dot are ignored.

    Raises:
        ViewError: If there is no path, or no recording at one.
    """
    recordings: list[Path] = []
    for path in paths:
        found = [path] if path.is_file() else sorted(_visible(path))
        if not found:
            raise ViewError(f"paths: expected a recording (.mcap) or a folder of recordings, got {path}")
        recordings += found
    if not recordings:
        raise ViewError("paths: expected a recording (.mcap) or a folder of recordings, got none")
    return recordings


def _visible(folder: Path) -> Iterator[Path]:
    for path in folder.rglob("*.mcap"):
        if not any(part.startswith(".") for part in path.relative_to(folder).parts):
            yield path


def play_recording(path: Path, open_stream: OpenStream) -> None:
    """Sends a whole recording to a stream of its own, with its log times as the timeline.

    Raises:
        ViewError: If the file is corrupt, or no recording.
    """
    entries = _entries(path)
    header = next(entries, None)
    if header is None or header.schema not in KINDS:
        got = header.schema if header else "none"
        raise ViewError(f"{path}: first message: expected one of {', '.join(KINDS)}, got {got}")
    kind = KINDS[header.schema]
    with open_stream(kind.application, str(path)) as stream:
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.send_recording_name(kind.title(header.message))
        stream.send_blueprint(
            rrb.Blueprint(
                kind.views, rrb.TimePanel(timeline="time", state="collapsed"), rrb.SelectionPanel(state="hidden")
            )
        )
        try:
            kind.header(stream, header.message)
            for entry in entries:
                stream.set_time("time", duration=np.timedelta64(entry.time, "ns"))
                stream.set_time("step", sequence=entry.step)
                if show := kind.messages.get(entry.schema):
                    show(stream, entry.message)
        except ValueError as error:
            raise ViewError(f"{path}: {error}") from error


def _blueprint(kind: Kind) -> rrb.Blueprint:
    return rrb.Blueprint(
        kind.views, rrb.TimePanel(timeline="time", state="collapsed"), rrb.SelectionPanel(state="hidden")
    )


def _entries(path: Path) -> Iterator[Entry]:
    """Messages in the order of the file."""
    try:
        with path.open("rb") as file:
            reader = NonSeekingReader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for schema, _, message, decoded in reader.iter_decoded_messages(log_time_order=False):
                yield Entry(schema.name if schema else "", message.sequence, message.log_time, decoded)
    except Exception as error:  # A corrupt file raises errors of several layers: zstd, struct, ...
        raise ViewError(f"{path}: expected a recording, got {type(error).__name__}: {error}") from error
