"""Images from recordings, MCAP files of one episode each."""

import os
from collections.abc import Iterator
from typing import Any

from cpn_client.errors import invalid
from cpn_client.image import SIZE, Image

EPISODE, TRIAL, FRAME = "cpn.v1.RecordedEpisode", "cpn.v1.RecordedTrial", "foxglove.RawImage"


def recorded_goal(path: str | os.PathLike[str]) -> Image:
    """Goal image of a recording: the last frame of a demonstration, or the goal of a trial.

    Raises:
        ValueError: If the file is no recording or corrupt, or has no frame of 84 x 84 pixels.
        ImportError: If the extra `recordings` is not installed.
        OSError: If the file cannot be read.
    """
    render_spec, last = "", None
    for name, message in _messages(path):
        if name == TRIAL:
            return Image(message.goal.data, message.goal.render_spec)
        if name == EPISODE:
            render_spec = message.render_spec
        elif name == FRAME:
            last = message
    return _image(path, last, render_spec)


def recorded_observation(path: str | os.PathLike[str]) -> Image:
    """First frame of a recording.

    Raises:
        ValueError, ImportError, OSError: As `recorded_goal`.
    """
    render_spec = ""
    for name, message in _messages(path):
        if name == FRAME:
            return _image(path, message, render_spec)
        if name == TRIAL:
            render_spec = message.goal.render_spec
        elif name == EPISODE:
            render_spec = message.render_spec
    return _image(path, None, render_spec)


def _messages(path: str | os.PathLike[str]) -> Iterator[tuple[str | None, Any]]:
    """Names of the types of a recording's messages, with the messages."""
    try:
        from mcap.reader import NonSeekingReader
        from mcap_protobuf.decoder import DecoderFactory
    except ModuleNotFoundError:
        raise ImportError("recording: needs mcap: pip install 'cpn-client[recordings]'") from None

    with open(path, "rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        topics = ["/episode", "/camera"]
        try:
            for schema, _, _, message in reader.iter_decoded_messages(topics=topics, log_time_order=False):
                yield schema.name if schema else None, message
        except OSError:
            raise
        # Of corrupt files: errors of MCAP, of its decompressors, of protobuf and of struct.
        except Exception as error:
            raise invalid(os.fspath(path), "a recording, an MCAP file", repr(error)) from None


def _image(path: str | os.PathLike[str], frame: Any, render_spec: str) -> Image:  # noqa: ANN401
    if frame is None or (frame.width, frame.height) != (SIZE, SIZE):
        got = f"{frame.width} x {frame.height}" if frame else "none"
        raise invalid(f"{os.fspath(path)}: frame", f"{SIZE} x {SIZE} pixels", got)
    return Image(frame.data, render_spec)
