"""SIGTERM: services end by themselves within ten seconds, whatever their clients do."""

import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cpn_stack.stack import Stack

PORTS = {"planner-0": "CPN_PORT_PLANNER_0", "trainer": "CPN_PORT_TRAINER"}

WATCH = """
import sys
from pathlib import Path
from cpn_stack.clients import channel
watch = channel(int(sys.argv[1]), Path(sys.argv[2])).unary_stream("/grpc.health.v1.Health/Watch")
for status in watch(b""):
    print("status", flush=True)
"""


@pytest.mark.parametrize("service", ["router", "planner-0", "planner-1", "trainer", "sim-worker"])
def test_stops_without_clients(stack: Stack, service: str) -> None:
    # 137 would say that it had to be killed; the router leaves SIGTERM to its default.
    assert stack.stop(stack.container(service)) == (143 if service == "router" else 0)


@pytest.mark.parametrize("service", PORTS)
def test_stops_with_a_silent_client(stack: Stack, service: str) -> None:
    with socket.create_connection(("127.0.0.1", stack.ports[PORTS[service]])):
        assert stack.stop(stack.container(service)) == 0


@pytest.mark.parametrize("service", PORTS)
def test_stops_with_a_hung_client(stack: Stack, certificates: Callable[[str], Path], service: str) -> None:
    """A gRPC client with a stream that neither reads nor answers."""
    command = [sys.executable, "-c", WATCH, str(stack.ports[PORTS[service]]), str(certificates("client"))]
    folder = Path(__file__).parents[1]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True, start_new_session=True) as client:
        assert client.stdout
        assert client.stdout.readline() == "status\n"
        client.send_signal(signal.SIGSTOP)
        try:
            assert stack.stop(stack.container(service)) == 0
        finally:
            client.kill()


def test_stops_without_a_router(stack: Stack) -> None:
    stack.kill(stack.container("router"))
    for service in ("planner-0", "trainer", "sim-worker"):
        assert stack.stop(stack.container(service)) == 0, service
