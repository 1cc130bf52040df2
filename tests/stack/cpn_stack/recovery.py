"""Time until an evaluation goes on."""

import time
from collections.abc import Sequence
from datetime import datetime

from cpn_stack.docker import inspect, wait_until
from cpn_stack.metrics import Metrics
from cpn_stack.stack import Stack

PLANS = "cpn_planner_plans_total"
STEADY_PLANS = 20
"""Plans after which an evaluation is under way again."""


def plans(metrics: Sequence[Metrics]) -> float:
    """Plans that were answered, by all planners that answer."""
    return sum(of_one.total(PLANS) or 0.0 for of_one in metrics)


def started_at(container: str) -> float:
    """When a container's process was started, in seconds since 1970."""
    # Nanoseconds are more digits than Python reads.
    return datetime.fromisoformat(inspect(container, ".State.StartedAt")[:26].rstrip("Z") + "+00:00").timestamp()


def wait_for_plan(metrics: Sequence[Metrics], known: float) -> float:
    """Waits for a plan more than those that are known of; when it was seen, in seconds since 1970."""
    wait_until("a plan is answered", lambda: plans(metrics) > known, pause_seconds=0.02)
    return time.time()


def kill_router(stack: Stack, metrics: Sequence[Metrics]) -> float:
    """Kills and starts the router under an evaluation; the seconds from its start until a plan."""
    router = stack.container("router")
    enough = plans(metrics) + STEADY_PLANS
    wait_until("the evaluation is under way", lambda: plans(metrics) >= enough, pause_seconds=0.1)
    stack.kill(router)
    # What was under way when it died is answered by now, to nobody.
    time.sleep(0.2)
    known = plans(metrics)
    stack.start(router)
    return wait_for_plan(metrics, known) - started_at(router)


def kill_planner(stack: Stack, metrics: Metrics, service: str) -> float:
    """Kills and starts the only planner under an evaluation; the seconds from its start until a plan."""
    planner = stack.container(service)
    enough = plans([metrics]) + STEADY_PLANS
    wait_until("the evaluation is under way", lambda: plans([metrics]) >= enough, pause_seconds=0.1)
    stack.kill(planner)
    stack.start(planner)
    # It counts from nought again.
    return wait_for_plan([metrics], 0) - started_at(planner)
