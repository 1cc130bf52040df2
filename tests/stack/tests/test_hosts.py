"""A second host: another project with a network of its own, whose router is joined to that of the first."""

from collections.abc import Callable, Iterator

import pytest
from conftest import MODELS, TASKS, TRIALS

from cpn_stack.docker import docker, logs, wait_until
from cpn_stack.evaluation import Evaluation
from cpn_stack.stack import Stack


@pytest.fixture
def host_b(stack: Stack) -> Iterator[Stack]:
    """A router and a simulator, which have the certificates of the first host, and nothing else of it."""
    other = Stack()
    other.environment["CPN_ROUTER_CONNECT"] = '["tls/host-a:7447"]'
    between = f"{other.project}_between"
    docker("network", "create", between)
    try:
        docker("network", "connect", "--alias=host-a", between, stack.container("router"))
        other.compose("up", "--no-start", "--no-deps", "--no-build", "--scale", "sim-worker=1", "router", "sim-worker")
        for role in ("router", "worker"):
            stack.copy_certificates(role, other)
        docker("network", "connect", "--alias=host-b", between, other.container("router"))
        other.compose("up", "--detach", "--no-deps", "--no-build", "--scale", "sim-worker=1", "router", "sim-worker")
        yield other
    finally:
        other.down()
        docker("network", "disconnect", "--force", between, stack.container("router"))
        docker("network", "rm", between)


def test_simulator_of_another_host(stack: Stack, host_b: Stack, check: Callable[[Evaluation], None]) -> None:
    for worker in stack.containers("sim-worker"):
        stack.stop(worker)
    worker = host_b.container("sim-worker")
    wait_until("the simulator is ready", lambda: "is ready" in logs(worker))
    check(stack.evaluate("hosts", tasks=TASKS, models=MODELS, trials=TRIALS, workers=1))
