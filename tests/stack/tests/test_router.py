"""A router that is killed again and again."""

import logging
from collections.abc import Callable

import numpy as np

from cpn_stack.evaluation import Evaluation
from cpn_stack.metrics import Metrics
from cpn_stack.recovery import kill_router
from cpn_stack.stack import Stack

KILLS = 50

log = logging.getLogger(__name__)


def test_router_killed_fifty_times(
    stack: Stack, evaluate: Callable[[], Evaluation], check: Callable[[Evaluation], None], metrics: list[Metrics]
) -> None:
    evaluation = evaluate()
    seconds = [kill_router(stack, metrics) for _ in range(KILLS)]
    assert evaluation.is_running(), "the last kill came after the end"
    check(evaluation)
    p50, p95, longest = np.percentile(seconds, [50, 95, 100])
    log.info("recovery from %d kills of the router: p50 %.2f s, p95 %.2f s, max %.2f s", KILLS, p50, p95, longest)
