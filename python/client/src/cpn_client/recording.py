"""Goals from recordings, MCAP files of one episode each."""

import os

from cpn_client.errors import invalid
from cpn_client.image import SIZE, Image


def recorded_goal(path: str | os.PathLike[str]) -> Image:
    """Goal image of a recording: the last frame of a demonstration, or the goal of a trial.

    Raises:
        ValueError: If the recording has no frame of 84 x 84 pixels.
        ImportError: If the extra `recordings` is not installed.
        OSError: If the file cannot be read.
        mcap.exceptions.McapError: If the file is corrupt.
    """
    try:
        from mcap.reader import NonSeekingReader
        from mcap_protobuf.decoder import DecoderFactory
    except ModuleNotFoundError:
        raise ImportError("recording: needs mcap: pip install 'cpn-client[recordings]'") from None

    render_spec, last = "", None
    with open(path, "rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        topics = ["/episode", "/camera"]
        for schema, _, _, message in reader.iter_decoded_messages(topics=topics, log_time_order=False):
            name = schema.name if schema else None
            if name == "cpn.v1.RecordedTrial":
                return Image(message.goal.data, message.goal.render_spec)
            if name == "cpn.v1.RecordedEpisode":
                render_spec = message.render_spec
            elif name == "foxglove.RawImage":
                last = message
    if last is None or (last.width, last.height) != (SIZE, SIZE):
        got = f"{last.width} x {last.height}" if last else "none"
        raise invalid(f"{os.fspath(path)}: frame", f"{SIZE} x {SIZE} pixels", got)
    return Image(last.data, render_spec)
