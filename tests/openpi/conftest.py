import os
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import grpc
import numpy as np
import pytest
from numpy.typing import NDArray
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from PIL import Image

from cpn.v1 import planner_pb2_grpc, types_pb2

ROOT = Path(__file__).resolve().parents[2]
PLANNER = os.environ.get("CPN_PLANNER", str(ROOT / "target/debug/cpn-planner"))


@dataclass
class Planner:
    """A planner's process with the shipped checkpoints, where it listens."""

    openpi_port: int
    grpc: planner_pb2_grpc.PlannerServiceStub

    def connect(self, **options: str) -> WebsocketClientPolicy:
        return WebsocketClientPolicy("127.0.0.1", self.openpi_port, **options)


@pytest.fixture(scope="session")
def planner() -> Iterator[Planner]:
    options = ["--models-dir", str(ROOT / "models"), "--grpc-listen", "127.0.0.1:0", "--openpi-listen", "127.0.0.1:0"]
    with subprocess.Popen([PLANNER, *options], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr
        log = ""
        for line in process.stderr:
            log += line
            if ready := re.search(r"grpc=(\S+) openpi=\S+:(\d+)", line):
                break
        else:
            pytest.fail(f"no planner:\n{log}")
        with grpc.insecure_channel(ready[1]) as channel:
            yield Planner(int(ready[2]), planner_pb2_grpc.PlannerServiceStub(channel))
        process.terminate()
        assert process.wait(30) == 0


@pytest.fixture
def pictures() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A frame and a goal, 84 x 84 x 3."""
    frame, goal = (np.asarray(Image.open(ROOT / f"examples/{name}.png").convert("RGB")) for name in ("frame", "goal"))
    assert frame.shape == goal.shape == (84, 84, 3)
    return frame, goal


def message(picture: NDArray[np.uint8]) -> types_pb2.Image:
    """A picture as the planner's own clients send it."""
    return types_pb2.Image(height=84, width=84, format=types_pb2.PIXEL_FORMAT_RGB8, data=picture.tobytes())
