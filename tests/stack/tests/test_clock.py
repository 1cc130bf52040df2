"""Clocks that jump: results are those of good ones."""

import time
from collections.abc import Callable

from cpn_stack.docker import docker
from cpn_stack.evaluation import Evaluation
from cpn_stack.stack import ROOT, Stack


def jump(container: str, seconds: int) -> None:
    """Sets a container's clock that far from the host's."""
    docker("exec", container, "sh", "-c", f"echo {seconds:+d} > /tmp/clock")
    now = int(docker("exec", container, "date", "+%s"))
    assert abs(now - time.time() - seconds) < 60, f"{container} says {now}"


def test_clock_jumps(stack: Stack, evaluate: Callable[[], Evaluation], check: Callable[[Evaluation], None]) -> None:
    for image in ("cpn-planner", "cpn-sim-worker"):
        context = str(ROOT / "tests/stack/inside/clock")
        docker("build", "--build-arg", f"BASE={image}", "--tag", f"{image}:clock", context)
    services = ("planner-0", "sim-worker")
    stack.compose("up", "--detach", "--no-deps", "--no-build", *services, further_file=ROOT / "tests/stack/clock.yml")
    stack.wait_healthy("planner-0")
    evaluation = evaluate()
    planner, worker = (stack.container(service) for service in services)
    for hours in (1, -1, 24, -24):
        jump(planner, 3600 * hours)
        jump(worker, -3600 * hours)
        evaluation.wait_for_trials(evaluation.finished_trials() + 4)
    assert evaluation.is_running(), "the clocks jumped after the end"
    check(evaluation)
