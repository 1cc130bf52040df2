"""Networks that are cut, slow or lossy: results are those of a good one."""

import logging
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from cpn_stack.docker import docker, logs, wait_until
from cpn_stack.evaluation import Evaluation
from cpn_stack.stack import ROOT, Stack

Evaluate = Callable[[], Evaluation]
Check = Callable[[Evaluation], None]

IMAGE = "cpn-test-impair"

log = logging.getLogger(__name__)


@pytest.mark.parametrize("seconds", [3, 25])
def test_worker_cut_off(stack: Stack, evaluate: Evaluate, check: Check, seconds: int) -> None:
    evaluation = evaluate()
    # Shorter and longer than zenoh's lease.
    with stack.cut_off(stack.containers("sim-worker")[0]):
        time.sleep(seconds)
    check(evaluation)


@pytest.mark.parametrize("seconds", [3, 25])
def test_planner_cut_off(stack: Stack, evaluate: Evaluate, check: Check, seconds: int) -> None:
    evaluation = evaluate()
    with stack.cut_off(stack.container("planner-0")):
        time.sleep(seconds)
    check(evaluation)


@contextmanager
def impaired(container: str) -> Iterator[None]:
    """Delays what a container sends by 40 to 60 ms, so that packets overtake each other, and loses one in a hundred."""
    name = f"{container}-impair"
    network = f"--network=container:{container}"
    docker("run", "--detach", "--name", name, network, "--cap-drop=ALL", "--cap-add=NET_ADMIN", IMAGE)
    try:
        wait_until("the network is impaired", lambda: "impaired by " in logs(name))
        yield
        docker("stop", name)
        told = logs(name)
        log.info("%s: %s", container, told)
        lost = re.search(r"lost (\d+)|dropped (\d+)", told)
        assert lost, told
        assert int(lost[1] or lost[2]) > 0, told
    finally:
        docker("rm", "--force", name)


def test_delay_loss_and_reordering(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    docker("build", "--tag", IMAGE, str(ROOT / "tests/stack/inside/impair"))
    with ExitStack() as started:
        for container in (stack.containers("sim-worker")[0], stack.container("planner-0")):
            started.enter_context(impaired(container))
        check(evaluate())


def test_slow_subscriber(stack: Stack, evaluate: Evaluate, check: Check) -> None:
    """A viewer of every frame that reads none."""
    script = (
        "import os, signal, time, zenoh; from cpn_sim_worker.session import ZenohConfig, open_session\n"
        "with open_session(ZenohConfig()) as session:\n"
        "    frames = session.declare_subscriber('cpn/@v1/sim/*/frame', zenoh.handlers.FifoChannel(4))\n"
        "    first = frames.recv()\n"
        "    print('a frame', flush=True)\n"
        "    time.sleep(3600)\n"
    )
    options = ["--entrypoint", "python", "--volume", f"{stack.project}_certificates-viewer:/viewer:ro"]
    for name in ("ca", "certificate", "private-key"):
        options += ["-e", f"CPN_TLS_{name.upper().replace('-', '_')}=/viewer/{name}.pem"]
    viewer = stack.run("sim-worker", "-c", script, options=options)
    evaluation = evaluate()
    wait_until("the viewer sees a frame", lambda: "a frame" in logs(viewer))
    with stack.paused(viewer):
        check(evaluation)
    docker("rm", "--force", viewer)
