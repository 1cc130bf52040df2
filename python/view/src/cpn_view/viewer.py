"""Rerun's server and web viewer, in a process of their own."""

import os
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path

import rerun as rr
import rerun_cli

from cpn_view.error import ViewError

START_SECONDS = 30.0
"""Longest time until the server listens."""
STOP_SECONDS = 5.0
"""Longest time from SIGTERM to the server's end."""

BATCHES = rr.ChunkBatcherConfig(flush_tick=0.1)
"""Batches of what is logged within 0.1 s, since a viewer takes longer over many small ones."""


@dataclass(frozen=True)
class ViewerConfig:
    """Serving of the web viewer."""

    port: int = 9870
    """Port of the web viewer; the next port serves its data."""
    memory_limit_mib: int = 512
    """Memory for viewers that connect late, in MiB; the oldest data are dropped beyond it."""
    bind: str = "127.0.0.1"
    """Address to listen on."""
    insecure: bool = False
    """Listen beyond the loopback interface: without TLS, and to viewers without a login."""

    def __post_init__(self) -> None:
        if not 1 <= self.port < 65535:
            raise ViewError(f"--port: expected 1 to 65534, got {self.port}")
        if self.memory_limit_mib < 1:
            raise ViewError(f"--memory-limit-mib: expected at least 1, got {self.memory_limit_mib}")
        try:
            private = ip_address(self.bind).is_loopback
        except ValueError:
            raise ViewError(f"--bind: expected an IP address, got {self.bind!r}") from None
        if not private and not self.insecure:
            raise ViewError(f"--bind: expected an address of the loopback interface, or --insecure, got {self.bind}")


@dataclass(frozen=True)
class Viewer:
    """Running server, which streams connect to."""

    config: ViewerConfig
    process: subprocess.Popen[bytes]

    @property
    def data_url(self) -> str:
        """Address of the data."""
        return f"rerun+http://{self._host}:{self.config.port + 1}/proxy"

    @property
    def url(self) -> str:
        """Address of the web viewer."""
        return f"http://{self._host}:{self.config.port}/?url={self.data_url}"

    @property
    def _host(self) -> str:
        address = ip_address(self.config.bind)
        if address.is_unspecified:
            return "127.0.0.1"
        return f"[{address}]" if address.version == 6 else str(address)

    @contextmanager
    def stream(self, application: str, recording: str) -> Iterator[rr.RecordingStream]:
        """Recording that is sent to this server, all of it by the end of this context."""
        stream = rr.RecordingStream(application, recording_id=recording, batcher_config=BATCHES)
        stream.connect_grpc(self.data_url)
        try:
            yield stream
        finally:
            stream.disconnect()

    def check(self) -> None:
        """Checks that the server runs.

        Raises:
            ViewError: If it has ended.
        """
        if (status := self.process.poll()) is not None:
            raise ViewError(f"rerun: expected a running server, got exit status {status}")


@contextmanager
def serve(config: ViewerConfig) -> Iterator[Viewer]:
    """Server that ends with this context. Rerun's own `serve_grpc` would listen on every interface.

    Raises:
        ViewError: If a port is taken, or the server does not start.
    """
    ports = (config.port, config.port + 1)
    for port in ports:
        _require_free(config.bind, port)
    command = [
        str(Path(rerun_cli.__file__).with_name("rerun")),
        "--serve-web",
        f"--bind={config.bind}",
        f"--web-viewer-port={ports[0]}",
        f"--port={ports[1]}",
        f"--server-memory-limit={config.memory_limit_mib}MiB",
    ]
    environment = {"RUST_LOG": "warn"} | os.environ
    # In a session of its own, so that Ctrl-C ends it only after the streams.
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment, start_new_session=True) as process:
        viewer = Viewer(config, process)
        try:
            _wait(viewer, ports)
            yield viewer
        finally:
            process.terminate()
            try:
                process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()


def _require_free(bind: str, port: int) -> None:
    try:
        socket.create_server((bind, port), family=_family(bind)).close()
    except OSError as error:
        raise ViewError(f"--port: expected two free ports, got {port}: {error.strerror}") from None


def _family(bind: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ip_address(bind).version == 6 else socket.AF_INET


def _wait(viewer: Viewer, ports: tuple[int, int]) -> None:
    end = time.monotonic() + START_SECONDS
    while not all(_listens(viewer.config.bind, port) for port in ports):
        viewer.check()
        if time.monotonic() > end:
            raise ViewError(f"rerun: expected a server on ports {ports} within {START_SECONDS} s, got none")
        time.sleep(0.05)


def _listens(bind: str, port: int) -> bool:
    with socket.socket(_family(bind)) as probe:
        return probe.connect_ex((bind, port)) == 0
