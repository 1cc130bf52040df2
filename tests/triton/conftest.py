import json
import os
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from tritonclient.grpc import InferenceServerClient

ROOT = Path(__file__).resolve().parents[2]
PLANNER = os.environ.get("CPN_PLANNER", str(ROOT / "target/debug/cpn-planner"))


@dataclass
class Planner:
    """A planner's process with the shipped checkpoints, and Triton's client of it."""

    address: str
    # InferenceServerClient, whose methods are typed as if each could return None.
    triton: Any

    def reference(self, model: str, seed: int, *updates: int) -> dict[str, Any]:
        """The plan that cpn-client gets for the pictures of the examples."""
        program = [ROOT / "examples/.venv/bin/python", "tests/triton/reference.py"]
        arguments = [f"grpc://{self.address}", model, str(seed), *map(str, updates)]
        return json.loads(subprocess.check_output([*program, *arguments], cwd=ROOT))


@pytest.fixture(scope="session")
def planner() -> Iterator[Planner]:
    options = ["--models-dir", str(ROOT / "models"), "--grpc-listen", "127.0.0.1:0"]
    with subprocess.Popen([PLANNER, *options], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr
        log = ""
        for line in process.stderr:
            log += line
            if ready := re.search(r"ready.* grpc=(\S+)", line):
                break
        else:
            pytest.fail(f"no planner:\n{log}")
        with InferenceServerClient(ready[1]) as client:
            yield Planner(ready[1], client)
        process.terminate()
        assert process.wait(30) == 0


@pytest.fixture
def pictures() -> dict[str, NDArray[np.uint8]]:
    """A frame and a goal, [84, 84, 3], by the names of their tensors."""
    files = {"observation": "frame", "goal": "goal"}
    return {name: np.asarray(Image.open(ROOT / f"examples/{file}.png").convert("RGB")) for name, file in files.items()}
