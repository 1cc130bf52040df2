"""Examples that use the client, as a person runs them."""

import os
import subprocess
import sys

import pytest
from conftest import FRAME, GOAL, ROOT, PlannerProcess

UV = os.environ.get("UV", "uv")
"""Program that runs these tests."""


def output(*command: str) -> str:
    return subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout


def test_plan_is_printed_over_either_transport(process: PlannerProcess) -> None:
    for address in (process.zenoh, process.grpc):
        assert "of 5 planned actions" in output(sys.executable, "examples/plan.py", str(GOAL), str(FRAME), address)


@pytest.mark.parametrize("example", ["closed_loop", "gymnasium_loop"])
def test_task_is_solved_in_closed_loop(process: PlannerProcess, example: str) -> None:
    environment = ["--quiet", "--project", "sim-worker", "--with-editable", "python/client"]
    task = [f"examples/{example}.py", "plate-slide", "1000000", process.zenoh]
    assert output(UV, "run", *environment, *task).startswith("plate-slide solved after ")
