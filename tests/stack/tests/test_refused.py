"""Those who do not belong, and what they may not do."""

from collections.abc import Callable
from pathlib import Path

import grpc
import pytest
import zenoh

from cpn.v1 import planner_pb2
from cpn_stack import clients
from cpn_stack.docker import docker, inspect, logs, read_folder, wait_until, write_file
from cpn_stack.metrics import Metrics
from cpn_stack.stack import ROOT, USER, Stack

Certificates = Callable[[str], Path]

LIST_MODELS = planner_pb2.ListModelsRequest()
TIMEOUT_SECONDS = 60


def test_second_planner_of_a_name(stack: Stack) -> None:
    second = stack.run("planner-0")
    wait_until("the second planner ends", lambda: inspect(second, ".State.Running") == "false")
    assert inspect(second, ".State.ExitCode") != "0"
    assert "name: expected one that no running service has, got that of cpn/@v1/alive/planner/planner-0" in logs(second)
    assert inspect(stack.container("planner-0"), ".State.Health.Status") == "healthy"


def test_second_worker_of_a_name(stack: Stack) -> None:
    first = stack.containers("sim-worker")[0]
    wait_until("the first worker is ready", lambda: "is ready" in logs(first))
    name = inspect(first, ".Config.Hostname")
    second = stack.run("sim-worker", "serve", "--worker", name, options=["--entrypoint", "cpn-sim-worker"])
    wait_until("the second worker ends", lambda: inspect(second, ".State.Running") == "false")
    assert inspect(second, ".State.ExitCode") != "0"
    assert f"worker: expected a name that no running worker has, got {name!r}" in logs(second)


def router_log_grows(stack: Stack, text: str, before: int) -> None:
    wait_until(f"the router logs {text!r}", lambda: stack.logs("router").count(text) > before)


def test_plaintext_client(stack: Stack) -> None:
    text = "received corrupt message"
    before = stack.logs("router").count(text)
    with pytest.raises(zenoh.ZError):
        clients.open_zenoh(f"tcp/127.0.0.1:{stack.ports['CPN_PORT_ROUTER']}", None)
    router_log_grows(stack, text, before)


@pytest.fixture
def strangers(tmp_path: Path) -> Path:
    """Certificates of an authority that nobody here knows."""
    name = docker("create", "cpn-certs", "init", "--dir", "/tmp/strangers", "--host", "router")  # noqa: S108
    docker("start", "--attach", name)
    for file, content in read_folder(name, "/tmp/strangers/operator").items():  # noqa: S108
        (tmp_path / file).write_bytes(content)
    docker("rm", name)
    return tmp_path


def test_wrong_authority(stack: Stack, certificates: Certificates, strangers: Path) -> None:
    endpoint = f"tls/localhost:{stack.ports['CPN_PORT_ROUTER']}"
    # One who belongs is let in, and takes no stranger for the router.
    clients.open_zenoh(endpoint, certificates("operator")).close()
    with pytest.raises(zenoh.ZError):
        clients.open_zenoh(endpoint, certificates("operator"), ca=strangers)
    # The router takes no stranger for one who belongs.
    before = stack.logs("router").count("invalid peer certificate")
    with pytest.raises(zenoh.ZError):
        clients.open_zenoh(endpoint, strangers, ca=certificates("operator"))
    router_log_grows(stack, "invalid peer certificate", before)

    with clients.open_grpc(stack.ports["CPN_PORT_PLANNER_0"], certificates("operator")) as planner:
        assert planner.ListModels(LIST_MODELS, timeout=TIMEOUT_SECONDS).models
    (strangers / "ca.pem").write_bytes((certificates("operator") / "ca.pem").read_bytes())
    before = stack.logs("planner-0").count("a TLS handshake failed")
    with clients.open_grpc(stack.ports["CPN_PORT_PLANNER_0"], strangers) as planner:
        with pytest.raises(grpc.RpcError) as refusal:
            planner.ListModels(LIST_MODELS, timeout=TIMEOUT_SECONDS)
        assert "StatusCode.UNAVAILABLE" in str(refusal.value)
    wait_until("it is logged", lambda: stack.logs("planner-0").count("a TLS handshake failed") > before)


def digests(stack: Stack, certificates: Certificates) -> dict[str, str]:
    with clients.open_grpc(stack.ports["CPN_PORT_PLANNER_0"], certificates("operator")) as planner:
        served = planner.ListModels(LIST_MODELS, timeout=TIMEOUT_SECONDS)
        return {model.name: model.digest for model in served.models}


def test_load_model_by_a_client(stack: Stack, certificates: Certificates, metrics: list[Metrics]) -> None:
    served = digests(stack, certificates)
    request = planner_pb2.LoadModelRequest(model="cpn", file="bc.safetensors")
    before = metrics[0].total("cpn_access_refused_total") or 0
    with clients.open_grpc(stack.ports["CPN_PORT_PLANNER_0"], certificates("client")) as planner:
        with pytest.raises(grpc.RpcError) as refusal:
            planner.LoadModel(request, timeout=TIMEOUT_SECONDS)
        assert "StatusCode.PERMISSION_DENIED" in str(refusal.value)
    assert metrics[0].total("cpn_access_refused_total") == before + 1
    assert any(
        "LoadModel" in line and "client" in line for line in stack.logs("planner-0").splitlines() if "WARN" in line
    )

    endpoint = f"tls/localhost:{stack.ports['CPN_PORT_ROUTER']}"
    with clients.open_zenoh(endpoint, certificates("client")) as session:
        replies = session.get("cpn/@v1/planner/planner-0/list_models", payload=b"", timeout=10)
        answers = [reply.ok.payload.to_bytes() for reply in replies if reply.ok]
        assert any(planner_pb2.ListModelsResponse.FromString(answer).models for answer in answers)
        payload = request.SerializeToString()
        replies = list(session.get("cpn/@v1/planner/planner-0/load_model", payload=payload, timeout=10))
        assert not any(reply.ok for reply in replies)
    assert digests(stack, certificates) == served
    # The same by one who may.
    with clients.open_zenoh(endpoint, certificates("operator")) as session:
        wait_until("the operator's request is answered", lambda: _loads(session, payload))
    assert digests(stack, certificates)["cpn"] == served["bc"]
    stack.kill(stack.container("planner-0"))


def _loads(session: zenoh.Session, payload: bytes) -> bool:
    replies = session.get("cpn/@v1/planner/planner-0/load_model", payload=payload, timeout=10)
    return any(reply.ok is not None for reply in replies)


def test_unsigned_checkpoint(stack: Stack, certificates: Certificates, metrics: list[Metrics]) -> None:
    served = digests(stack, certificates)
    weights = (ROOT / "models/bc.safetensors").read_bytes()
    before = metrics[0].total("cpn_planner_checkpoints_refused_total") or 0
    with clients.open_grpc(stack.ports["CPN_PORT_PLANNER_0"], certificates("operator")) as planner:
        with pytest.raises(grpc.RpcError) as refusal:
            planner.LoadModel(planner_pb2.LoadModelRequest(model="cpn", checkpoint=weights), timeout=TIMEOUT_SECONDS)
        assert "StatusCode.FAILED_PRECONDITION" in str(refusal.value)
        assert "signature: expected " in str(refusal.value)

    # Published by the trainer, with everybody's certificates in order.
    docker("exec", stack.container("trainer"), "mkdir", "-p", "/data/checkpoints")
    write_file(stack.container("trainer"), "/data/checkpoints", "cpn.safetensors", weights, USER)
    text = "checkpoint refused: no trusted key signed it"
    for planner in ("planner-0", "planner-1"):
        wait_until(f"{planner} refuses", lambda name=planner: text in stack.logs(name))
    assert digests(stack, certificates) == served
    assert (metrics[0].total("cpn_planner_checkpoints_refused_total") or 0) >= before + 2
    docker("exec", stack.container("trainer"), "rm", "/data/checkpoints/cpn.safetensors")
