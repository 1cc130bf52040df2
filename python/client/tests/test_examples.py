"""Examples that use the client, as a person runs them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import FRAME, GOAL, PROGRAMS, ROOT, PlannerProcess, free_port

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


def test_own_task_is_demonstrated_trained_and_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CPN_PLANNER_GRPC_LISTEN", f"127.0.0.1:{free_port()}")
    options = ["--folder", str(tmp_path), "--programs", str(PROGRAMS)]
    small = ["--demonstrations", "8", "--epochs", "2", "--trials", "2"]
    printed = output(UV, "run", "--quiet", "--project", "examples", "examples/own_task.py", *options, *small)
    assert "8 episodes, dataset digest" in printed
    assert re.search(r"^solved: [012] of 2 with plans, [012] of 2 with random actions$", printed, re.MULTILINE)
