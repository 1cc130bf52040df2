"""Command line of the view."""

import logging
import signal
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated
from uuid import uuid4

import tyro
import zenoh

from cpn_view.error import ViewError
from cpn_view.live import APPLICATION, LiveView
from cpn_view.play import find_recordings, play_recording
from cpn_view.session import ZenohConfig, open_session
from cpn_view.viewer import ViewerConfig, serve


@dataclass(frozen=True)
class LiveConfig:
    """Show the simulator workers of a network, as they run, until SIGTERM or SIGINT."""

    viewer: ViewerConfig = field(default_factory=ViewerConfig)
    zenoh: ZenohConfig = field(default_factory=ZenohConfig)


@dataclass(frozen=True)
class PlayConfig:
    """Show recorded trials and demonstrations until SIGTERM or SIGINT."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Recordings (.mcap), or folders of them."""
    viewer: ViewerConfig = field(default_factory=ViewerConfig)


Live = Annotated[LiveConfig, tyro.conf.subcommand("live")]
Play = Annotated[PlayConfig, tyro.conf.subcommand("play")]


def main() -> None:
    """Runs the subcommand that the arguments name."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    # Zenoh's own log, as set by RUST_LOG.
    zenoh.try_init_log_from_env()
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        match tyro.cli(Live | Play, prog="cpn-view", config=(tyro.conf.OmitArgPrefixes,)):
            case LiveConfig() as config:
                live(config, stop)
            case PlayConfig() as config:
                play(config, stop)
    except ViewError as error:
        sys.exit(f"cpn-view: {error}")


def live(config: LiveConfig, stop: threading.Event) -> None:
    """Shows the workers until `stop` is set."""
    with open_session(config.zenoh) as session, serve(config.viewer) as viewer:
        print(viewer.url, flush=True)
        with viewer.stream(APPLICATION, uuid4().hex) as stream:
            LiveView(session, stream).run(stop, viewer.check)


def play(config: PlayConfig, stop: threading.Event) -> None:
    """Shows the recordings until `stop` is set."""
    recordings = find_recordings(config.paths)
    with serve(config.viewer) as viewer:
        print(viewer.url, flush=True)
        for path in recordings:
            if stop.is_set():
                return
            play_recording(path, viewer.stream)
        while not stop.wait(1):
            viewer.check()
