"""Services that are killed or paused while an evaluation runs: its results are those without."""

import re
import time
from collections.abc import Callable

from conftest import MODELS, TASKS, TRIALS

from cpn_stack.docker import docker, logs, wait_until
from cpn_stack.evaluation import Evaluation
from cpn_stack.stack import Stack

Evaluate = Callable[[], Evaluation]
Check = Callable[[Evaluation], None]


def test_planner_killed(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    planner = stack.container("planner-0")
    stack.kill(planner)
    # Longer than trials wait for it: they begin anew with the other one.
    wait_until("a trial begins anew", lambda: "planner planner-0: " in evaluation.log())
    stack.start(planner)
    check(evaluation)


def test_planner_killed_and_started(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    planner = stack.container("planner-0")
    for trials in (5, 15, 25):
        evaluation.wait_for_trials(trials)
        stack.kill(planner)
        stack.start(planner)
    check(evaluation)


def test_planners_killed_one_after_the_other(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    first, second = stack.container("planner-0"), stack.container("planner-1")
    stack.kill(first)
    evaluation.wait_for_trials(8)
    # Now there is none.
    stack.kill(second)
    time.sleep(3)
    stack.start(first)
    evaluation.wait_for_trials(16)
    stack.start(second)
    stack.wait_healthy("planner-1")
    stack.kill(first)
    evaluation.wait_for_trials(24)
    stack.start(first)
    check(evaluation)


def test_worker_killed(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    worker = stack.containers("sim-worker")[0]
    stack.kill(worker)
    wait_until("a trial begins anew", lambda: "begins anew" in evaluation.log())
    stack.start(worker)
    check(evaluation)


def test_workers_join_and_leave(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    stack.compose("up", "--detach", "--no-deps", "--no-build", "--scale", "sim-worker=4", "sim-worker")
    for worker in stack.containers("sim-worker"):
        wait_until("the worker is ready", lambda name=worker: "is ready" in logs(name))
    evaluation.wait_for_trials(30)
    stack.compose("up", "--detach", "--no-deps", "--no-build", "--scale", "sim-worker=1", "sim-worker")
    assert evaluation.is_running(), "the workers left after the end"
    check(evaluation)


def test_worker_paused(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    # Longer than zenoh's lease.
    with stack.paused(stack.containers("sim-worker")[0]):
        time.sleep(20)
    check(evaluation)


def test_planner_paused(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    with stack.paused(stack.container("planner-0")):
        time.sleep(20)
    check(evaluation)


def test_router_paused(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    with stack.paused(stack.container("router")):
        time.sleep(20)
    check(evaluation)


def test_evaluator_killed(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    evaluation.wait_for_trials(20)
    evaluation.kill()
    again = stack.evaluate("evaluator_killed", tasks=TASKS, models=MODELS, trials=TRIALS)
    check(again)
    kept = re.search(r"(\d+) of 64 trials are there already", again.log())
    assert kept
    assert int(kept[1]) >= 20


def test_evaluator_told_to_stop(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    evaluation = evaluate()
    evaluation.wait_for_trials(20)
    docker("stop", "--time", "10", evaluation.container)
    assert "interrupted with" in evaluation.log()
    check(stack.evaluate("evaluator_told_to_stop", tasks=TASKS, models=MODELS, trials=TRIALS))
