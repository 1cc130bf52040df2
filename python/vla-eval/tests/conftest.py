import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PROGRAMS = Path(os.environ.get("CPN_PROGRAMS", ROOT / "target/debug"))
FRAME, GOAL = ROOT / "examples/frame.png", ROOT / "examples/goal.png"


@pytest.fixture(scope="session")
def address() -> Iterator[str]:
    """Address of a planner with the shipped checkpoints."""
    command = [PROGRAMS / "cpn-planner", "--models-dir", ROOT / "models", "--grpc-listen", "127.0.0.1:0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr
        log = ""
        for line in process.stderr:
            log += line
            if ready := re.search(r"planner is ready.* grpc=(\S+)", line):
                break
        else:
            pytest.fail(log)
        yield f"grpc://{ready[1]}"
        process.terminate()
        assert process.wait(30) == 0
