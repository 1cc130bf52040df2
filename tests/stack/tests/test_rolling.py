"""Planners that are replaced one after the other under load."""

from collections.abc import Callable

from cpn_stack.docker import docker, inspect
from cpn_stack.evaluation import Evaluation
from cpn_stack.stack import ROOT, Stack

Evaluate = Callable[[], Evaluation]
Check = Callable[[Evaluation], None]


def test_rolling_restart(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    for planner in ("planner-0", "planner-1"):
        assert stack.stop(stack.container(planner)) == 0
        stack.start(stack.container(planner))
        stack.wait_healthy(planner)
    assert evaluation.is_running(), "the restarts came after the end"
    check(evaluation)


def test_rolling_upgrade(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    docker("tag", "cpn-planner", "cpn-planner:next")
    upgrade = ROOT / "tests/stack/upgrade.yml"
    evaluation = evaluate()
    for planner in ("planner-0", "planner-1"):
        before = stack.container(planner)
        identity = inspect(before, ".Id")
        stack.compose("up", "--detach", "--no-deps", "--no-build", planner, further_file=upgrade)
        stack.wait_healthy(planner)
        after = stack.container(planner)
        assert inspect(after, ".Id") != identity
        assert inspect(after, ".Config.Image") == "cpn-planner:next"
    assert evaluation.is_running(), "the upgrades came after the end"
    check(evaluation)
    docker("rmi", "cpn-planner:next")
