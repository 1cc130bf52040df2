"""Unmodified clients of openpi and gRPC, and a planner that listens with TLS."""

import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import grpc
import pytest
from conftest import PLANNER, ROOT
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from websockets.exceptions import InvalidStatus

from cpn.v1 import planner_pb2, planner_pb2_grpc

CERTS = os.environ.get("CPN_CERTS", str(ROOT / "target/debug/cpn-certs"))


@dataclass
class SecurePlanner:
    """A planner's process with the random model, its network's files, and a token of a client."""

    files: Path
    grpc_port: int
    openpi_port: int
    token: str

    def openpi(self, api_key: str | None) -> WebsocketClientPolicy:
        return WebsocketClientPolicy("wss://localhost", self.openpi_port, api_key=api_key)

    @contextmanager
    def grpc(self, identity: str) -> Iterator[planner_pb2_grpc.PlannerServiceStub]:
        """Its gRPC service, called with the certificate of an identity."""
        folder = self.files / identity
        files = [(folder / name).read_bytes() for name in ("ca.pem", "private-key.pem", "certificate.pem")]
        credentials = grpc.ssl_channel_credentials(*files)
        with grpc.secure_channel(f"localhost:{self.grpc_port}", credentials) as channel:
            yield planner_pb2_grpc.PlannerServiceStub(channel)


@pytest.fixture(scope="module")
def secure(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecurePlanner]:
    files, models = tmp_path_factory.mktemp("certificates"), tmp_path_factory.mktemp("models")
    certs = [CERTS, "--dir", str(files)]
    subprocess.run([*certs, "init"], check=True)
    token = subprocess.check_output([*certs, "token", "client.openpi"], text=True).strip()
    own = files / "planner"
    options = ["--models-dir", str(models), "--grpc-listen", "127.0.0.1:0", "--openpi-listen", "127.0.0.1:0"]
    options += ["--tls-ca", str(own / "ca.pem"), "--tls-certificate", str(own / "certificate.pem")]
    options += ["--tls-private-key", str(own / "private-key.pem"), "--tokens", str(own / "tokens.json")]
    with subprocess.Popen([PLANNER, *options], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr
        log = ""
        for line in process.stderr:
            log += line
            if ready := re.search(r"grpc=\S+:(\d+) openpi=\S+:(\d+)", line):
                break
        else:
            pytest.fail(log)
        yield SecurePlanner(files, int(ready[1]), int(ready[2]), token)
        process.terminate()


def test_openpis_client_trusts_the_authority_and_shows_its_key(
    secure: SecurePlanner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(secure.files / "client/ca.pem"))
    assert list(secure.openpi(secure.token).get_server_metadata()["models"]) == ["random"]
    for key in (None, "guessed"):
        with pytest.raises(InvalidStatus) as refused:
            secure.openpi(key)
        assert refused.value.response.status_code == 401


def test_grpcs_client_may_do_what_its_role_may(secure: SecurePlanner) -> None:
    with secure.grpc("client") as planner:
        served = planner.ListModels(planner_pb2.ListModelsRequest(), timeout=60).models
        assert [info.name for info in served] == ["random"]
        with pytest.raises(grpc.RpcError) as refused:
            planner.LoadModel(planner_pb2.LoadModelRequest(model="m", file="m.safetensors"), timeout=60)
    assert refused.value.code() == grpc.StatusCode.PERMISSION_DENIED  # pyright: ignore[reportAttributeAccessIssue]
