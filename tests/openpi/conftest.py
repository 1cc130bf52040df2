import os
import re
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message_factory import GetMessages
from grpc_tools import protoc
from numpy.typing import NDArray
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
PLANNER = os.environ.get("CPN_PLANNER", str(ROOT / "target/debug/cpn-planner"))


def _messages() -> dict[str, Any]:
    with tempfile.NamedTemporaryFile() as file:
        options = [f"-I{ROOT}/proto", f"--descriptor_set_out={file.name}", "--include_imports"]
        assert protoc.main(["", *options, "cpn/v1/planner.proto"]) == 0
        return GetMessages(FileDescriptorSet.FromString(file.read()).file)


MESSAGES = _messages()


@dataclass
class Planner:
    """A planner's process with the shipped checkpoints, where it listens."""

    openpi_port: int
    grpc: grpc.Channel

    def connect(self, **options: str) -> WebsocketClientPolicy:
        return WebsocketClientPolicy("127.0.0.1", self.openpi_port, **options)

    def call(self, method: str, **fields: object) -> Any:
        """What it answers over gRPC."""
        request, response = (MESSAGES[f"cpn.v1.{method}{kind}"] for kind in ("Request", "Response"))
        path = f"/cpn.v1.PlannerService/{method}"
        call = self.grpc.unary_unary(path, request.SerializeToString, response.FromString)
        return call(request(**fields), timeout=60)


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
            yield Planner(int(ready[2]), channel)
        process.terminate()
        assert process.wait(30) == 0


@pytest.fixture
def pictures() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A frame and a goal, 84 x 84 x 3."""
    frame, goal = (np.asarray(Image.open(ROOT / f"examples/{name}.png").convert("RGB")) for name in ("frame", "goal"))
    assert frame.shape == goal.shape == (84, 84, 3)
    return frame, goal


def message(picture: NDArray[np.uint8]) -> Any:
    """A picture as the planner's own clients send it."""
    return MESSAGES["cpn.v1.Image"](height=84, width=84, format="PIXEL_FORMAT_RGB8", data=picture.tobytes())
