import queue
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zenoh
from numpy.typing import NDArray

from cpn.v1 import types_pb2

COMMAND = str(Path(sys.executable).with_name("cpn-sim-worker"))
READY_SECONDS = 60.0

StartWorker = Callable[..., subprocess.Popen[bytes]]

UNSOLVED = ("door-open", 2)
"""A task and a seed whose variation the scripted expert fails; the next seed's it solves."""


def collect() -> tuple[Callable[[zenoh.Sample], None], "queue.Queue[zenoh.Sample]"]:
    """A handler for a subscriber that keeps its samples in a queue."""
    samples: queue.Queue[zenoh.Sample] = queue.Queue()
    return samples.put, samples


def wait_for_sample(subscriber: "zenoh.Subscriber[queue.Queue[zenoh.Sample]]", kind: zenoh.SampleKind) -> zenoh.Sample:
    """The next sample, which has to be of `kind`."""
    sample = subscriber.handler.get(timeout=READY_SECONDS)
    assert sample.kind == kind
    return sample


def pixels(image: types_pb2.Image) -> NDArray[np.uint8]:
    """An image's pixels, [height, width, 3]."""
    assert image.format == types_pb2.PIXEL_FORMAT_RGB8
    return np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
