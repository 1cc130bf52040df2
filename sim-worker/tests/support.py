import logging
import queue
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import zenoh
from numpy.typing import NDArray

from cpn.v1 import types_pb2
from cpn_sim_worker.session import StoppedError, ZenohConfig, open_session

COMMAND = str(Path(sys.executable).with_name("cpn-sim-worker"))
HEALTH_COMMAND = str(Path(sys.executable).with_name("cpn-sim-worker-health"))
READY_SECONDS = 60.0

StartWorker = Callable[..., subprocess.Popen[bytes]]

UNSOLVED = ("door-open", 2)
"""Task and seed of a variation that the scripted expert fails, unlike that of the next seed."""


def collect() -> tuple[Callable[[zenoh.Sample], None], "queue.Queue[zenoh.Sample]"]:
    """Subscriber's handler that queues its samples."""
    samples: queue.Queue[zenoh.Sample] = queue.Queue()
    return samples.put, samples


def wait_for_sample(subscriber: "zenoh.Subscriber[queue.Queue[zenoh.Sample]]", kind: zenoh.SampleKind) -> zenoh.Sample:
    """Next sample, which must be of `kind`."""
    sample = subscriber.handler.get(timeout=READY_SECONDS)
    assert sample.kind == kind
    return sample


def pixels(image: types_pb2.Image) -> NDArray[np.uint8]:
    """Pixels of an image, [height, width, 3]."""
    assert image.format == types_pb2.PIXEL_FORMAT_RGB8
    return np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)


def free_endpoint(protocol: str = "tcp", host: str = "127.0.0.1") -> str:
    """Free endpoint, below the ephemeral ports of the system.

    Of those, one that a client asks again and again might be handed to the client itself.
    """
    while True:
        port = random.randrange(20_000, 32_000)  # noqa: S311
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return f"{protocol}/{host}:{port}"


def router(endpoint: str) -> ZenohConfig:
    return ZenohConfig(mode="router", listen=(endpoint,))


def client(*endpoints: str) -> ZenohConfig:
    return ZenohConfig(mode="client", connect=endpoints)


def wait_for(condition: Callable[[], object]) -> None:
    """Waits until the condition holds."""
    end = time.monotonic() + READY_SECONDS
    while not condition():
        assert time.monotonic() < end, "the condition does not come true"
        time.sleep(0.02)


class Log(logging.Handler):
    """Messages of a logger, from all threads."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())

    def says(self, text: str) -> bool:
        return any(text in line for line in self.lines)


def assert_not_let_in(options: ZenohConfig, log: Log, reason: str) -> None:
    """Tries to join as a client until the log gives the reason for the refusal."""
    log.lines.clear()
    joined, stop = threading.Event(), threading.Event()

    def join() -> None:
        with suppress(StoppedError), open_session(options, stop):
            joined.set()

    thread = threading.Thread(target=join)
    thread.start()
    try:
        wait_for(lambda: joined.is_set() or log.says(reason))
    finally:
        stop.set()
        thread.join()
    assert not joined.is_set()
