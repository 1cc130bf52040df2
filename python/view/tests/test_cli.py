import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import rerun_cli

from tests.support import (
    Network,
    actions,
    blueprints,
    demonstration,
    frames,
    free_port,
    pictures,
    scalars,
    trial,
    wait_for,
)

VIEW = str(Path(sys.executable).with_name("cpn-view"))

# A file that is still written to has no footer.
pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")


@contextmanager
def running(*arguments: str) -> Iterator[str]:
    """Address of the data of a running view, which ends by SIGINT, with 0."""
    command = [VIEW, *arguments, "--port", str(free_port(2))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout
            url = process.stdout.readline().strip()
            with urllib.request.urlopen(url) as page:  # noqa: S310
                assert page.status == 200
            yield url.partition("?url=")[2]
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait() == 0


@contextmanager
def saved(url: str, rrd: Path) -> Iterator[None]:
    """Viewer that saves what it is sent, from when it connects."""
    rerun = str(Path(rerun_cli.__file__).with_name("rerun"))
    command = [rerun, "--bind=127.0.0.1", f"--port={free_port()}", f"--save={rrd}", url]
    with subprocess.Popen(command) as process:
        try:
            yield
        finally:
            process.terminate()


def wait_for_file(rrd: Path, condition: Callable[[], object]) -> None:
    """Waits until the condition holds for a file that another process writes, which may end within a message."""

    def holds() -> object:
        with suppress(RuntimeError):
            return rrd.exists() and condition()

    wait_for(holds)


def test_live(network: Network, rrd: Path) -> None:
    token = network.alive("w0")
    with running("live", "--connect", network.endpoint) as url, saved(url, rrd):
        wait_for_file(rrd, lambda: blueprints(rrd) == 2)
        for step in range(3):
            network.action("w0", step, actions(3, 4)[step])
            network.frame("w0", step + 1, frames(3)[step])
            wait_for_file(rrd, lambda: len(pictures(rrd, "/workers/w0/camera")) == step + 1)  # noqa: B023
    token.undeclare()
    np.testing.assert_array_equal(pictures(rrd, "/workers/w0/camera"), frames(3))
    np.testing.assert_array_equal(scalars(rrd, "/workers/w0/action"), actions(3, 4))


def test_play(tmp_path: Path, rrd: Path) -> None:
    paths = [demonstration(tmp_path / "all/a.mcap"), trial(tmp_path / "all/b.mcap")]
    with running("play", str(tmp_path / "all")) as url, saved(url, rrd):
        wait_for_file(rrd, lambda: len(pictures(rrd, "/camera")) == 12)
    recordings = rr.chunk.RrdReader(rrd).recordings()
    assert sorted(entry.recording_id for entry in recordings) == [str(path) for path in paths]


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["play", "nowhere.mcap"], "paths: expected a recording (.mcap) or a folder of recordings, got nowhere.mcap"),
        (["live"], "--connect (CPN_CONNECT): expected an endpoint of the network, got none"),
        (["live", "--port", "0"], "--port: expected 1 to 65534, got 0"),
    ],
)
def test_error(arguments: list[str], error: str) -> None:
    done = subprocess.run([VIEW, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert re.search(rf"^cpn-view: {re.escape(error)}$", done.stderr, re.MULTILINE)
