import subprocess
import sys

import pytest
import zenoh

from cpn_sim_worker import keys
from cpn_sim_worker.session import open_session
from tests.support import HEALTH_COMMAND, READY_SECONDS, StartWorker, client, free_endpoint, router, wait_for


def check(*options: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [HEALTH_COMMAND, *options]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def test_worker_behind_a_router_is_found() -> None:
    endpoint = free_endpoint()
    environment = {"CPN_MODE": "client", "CPN_CONNECT": endpoint}
    key = keys.sim_alive("w0")
    with open_session(router(endpoint)) as routing, open_session(client(endpoint)) as session:
        token = session.liveliness().declare_token(key)
        wait_for(lambda: list(routing.liveliness().get(key, timeout=READY_SECONDS)))
        healthy = check("--worker", "w0", **environment)
        assert (healthy.returncode, healthy.stdout, healthy.stderr) == (0, "", "")
        missing = check("--worker", "w1", **environment)
        assert missing.returncode == 1
        expected = f"worker w1 is not ready: nobody in the network holds the liveliness token {keys.sim_alive('w1')}\n"
        assert missing.stderr == expected
        token.undeclare()
        wait_for(lambda: not list(routing.liveliness().get(key, timeout=READY_SECONDS)))
        assert check("--worker", "w0", **environment).returncode == 1
    without_router = check("--worker", "w0", **environment)
    assert without_router.returncode == 1
    assert f"worker w0 is not ready: no router answers at {endpoint}" in without_router.stderr


def test_worker_among_peers_is_found(session: zenoh.Session, endpoint: str, start_worker: StartWorker) -> None:
    """A worker without a listening port is found by the endpoint that it connects to."""
    start_worker("watched")
    healthy = check("--worker", "watched", "--connect", endpoint)
    assert healthy.returncode == 0, healthy.stderr


def test_worker_that_others_connect_to_is_found(start_worker: StartWorker) -> None:
    own = free_endpoint()
    start_worker("hub", "--listen", own)
    healthy = check("--worker", "hub", CPN_LISTEN=own)
    assert healthy.returncode == 0, healthy.stderr


@pytest.mark.parametrize(
    ("environment", "reason"),
    [
        ({"CPN_MODE": "broker"}, "CPN_MODE: expected one of"),
        ({"CPN_USER": "somebody"}, "CPN_PASSWORD_FILE"),
        ({"CPN_MODE": "client"}, "--connect (CPN_CONNECT): expected the endpoint of a router"),
        ({}, "--connect (CPN_CONNECT): expected an endpoint of the network"),
    ],
)
def test_invalid_options_are_unhealthy(environment: dict[str, str], reason: str) -> None:
    run = check(**environment)
    assert run.returncode == 1
    assert reason in run.stderr


def test_check_imports_neither_simulator_nor_arrays() -> None:
    program = "import sys, cpn_sim_worker.health; print(*(name.partition('.')[0] for name in sys.modules))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not {"metaworld", "mujoco", "numpy", "scipy"} & set(run.stdout.split())
