"""Addresses, and the means to be let in."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import trustme
from conftest import FRAME, GOAL, PlannerProcess, running
from test_cli import Shell

import cpn_client
from cpn_client import RefusedError, Tls, UnreachableError

TOKEN = "secret"  # noqa: S105


@pytest.mark.parametrize(
    ("address", "options", "message"),
    [
        (
            "127.0.0.1:7447",
            {},
            "address: expected a zenoh endpoint, for example tcp/127.0.0.1:7447, or grpc://HOST:PORT",
        ),
        ("tcp/127.0.0.1:7447", {"name": "a/b"}, "name: expected the name of a planner, got 'a/b'"),
        ("tcp/127.0.0.1:7447", {"name": "*"}, "name: expected the name of a planner, got '\\*'"),
        (
            "grpc://127.0.0.1:1",
            {"namespace": "lab"},
            "address: expected a zenoh endpoint, as name or namespace is given",
        ),
        ("grpc://127.0.0.1:1", {"token": TOKEN}, "address: expected grpcs://HOST:PORT, as a token is given"),
        ("grpc://127.0.0.1:1", {"tls": Tls("ca.pem")}, "address: expected grpcs://HOST:PORT, as TLS files are given"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(address: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cpn_client.connect(address, **options)


def test_certificate_needs_its_key() -> None:
    with pytest.raises(ValueError, match="private_key: expected a file, as certificate is given, got None"):
        Tls("ca.pem", certificate="certificate.pem")
    with pytest.raises(ValueError, match="certificate: expected a file, as private_key is given, got None"):
        Tls("ca.pem", private_key="key.pem")


@dataclass
class Secure:
    """Planner with TLS, and the files of its client."""

    process: PlannerProcess
    tls: Tls


@pytest.fixture(scope="module")
def secure(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secure]:
    folder = tmp_path_factory.mktemp("tls")
    authority = trustme.CA()
    authority.cert_pem.write_to_path(str(folder / "ca.pem"))
    for name in ("planner", "client"):
        issued = authority.issue_cert("localhost", common_name=name)
        issued.private_key_pem.write_to_path(str(folder / f"{name}.key"))
        for number, blob in enumerate(issued.cert_chain_pems):
            blob.write_to_path(str(folder / f"{name}.pem"), append=number > 0)
    digest = hashlib.sha256(TOKEN.encode()).hexdigest()
    (folder / "tokens.json").write_text(json.dumps({"tokens": [{"identity": "client.lab", "sha256": digest}]}))
    options = ["--tls-ca", "ca.pem", "--tls-certificate", "planner.pem", "--tls-private-key", "planner.key"]
    files = [str(folder / option) if number % 2 else option for number, option in enumerate(options)]
    with running(*files, "--tokens", str(folder / "tokens.json"), scheme="tls", host="localhost") as process:
        yield Secure(process, Tls(folder / "ca.pem", folder / "client.pem", folder / "client.key"))


def test_certificate_lets_in(secure: Secure) -> None:
    for address in (secure.process.zenoh, secure.process.grpc):
        with cpn_client.connect(address, tls=secure.tls) as planner:
            assert len(planner.plan(model="cpn", goal=GOAL, observation=FRAME).actions) == 5


def test_token_lets_in(secure: Secure) -> None:
    with cpn_client.connect(secure.process.grpc, tls=Tls(secure.tls.ca), token=TOKEN) as planner:
        assert len(planner.plan(model="cpn", goal=GOAL, observation=FRAME).actions) == 5
    for token in ("", "guessed"):
        with pytest.raises(RefusedError, match=r"^UNAUTHENTICATED: expected an answer, got authorization"):
            cpn_client.connect(secure.process.grpc, tls=Tls(secure.tls.ca), token=token)


def test_command_line_is_let_in(secure: Secure, tmp_path: Path) -> None:
    shell, tls = Shell(tmp_path, secure.process.grpc), secure.tls
    options = ["--tls-ca", tls.ca, "--tls-certificate", str(tls.certificate), "--tls-private-key", str(tls.private_key)]
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    for let_in in (["--planner", secure.process.zenoh, *options], options, [*options[:2], "--token-file", "token"]):
        assert "te-bc" in shell.output("models", *let_in)


def test_environment_lets_in(secure: Secure, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    certificate = {"CPN_TLS_CERTIFICATE": secure.tls.certificate, "CPN_TLS_PRIVATE_KEY": secure.tls.private_key}
    for endpoint, others in (
        (secure.process.zenoh, certificate | {"CPN_TOKEN_FILE": ""}),
        (secure.process.grpc, {"CPN_TOKEN_FILE": tmp_path / "token"}),
    ):
        with monkeypatch.context() as environment:
            for variable, value in ({"CPN_CONNECT": endpoint, "CPN_TLS_CA": secure.tls.ca} | others).items():
                environment.setenv(variable, str(value))
            with cpn_client.connect_from_environment() as planner:
                assert "te-bc" in [model.name for model in planner.models()]
            environment.setenv("CPN_CONNECT", "nowhere")
            with cpn_client.connect_from_environment(endpoint) as planner:
                assert planner.models()


def test_environment_names_planner_and_namespace(monkeypatch: pytest.MonkeyPatch) -> None:
    with running("--name", "p7", "--namespace", "lab") as process:
        monkeypatch.setenv("CPN_CONNECT", process.zenoh)
        monkeypatch.setenv("CPN_PLANNER_NAME", "p7")
        monkeypatch.setenv("CPN_NAMESPACE", "lab")
        with cpn_client.connect_from_environment() as planner:
            assert planner.models()


@pytest.mark.parametrize(
    ("variable", "message"),
    [
        ("CPN_TLS_CERTIFICATE", "CPN_TLS_CA: expected a file, as none.pem is given, got none"),
        (
            "CPN_TOKEN_FILE",
            "CPN_TOKEN_FILE: expected a file with a token, got .* No such file or directory: ",
        ),
        ("CPN_CONNECT", "address: expected a zenoh endpoint, .*got 'none.pem'"),
    ],
)
def test_faulty_variables_are_named(monkeypatch: pytest.MonkeyPatch, variable: str, message: str) -> None:
    monkeypatch.setenv(variable, "none.pem")
    with pytest.raises(ValueError, match=message):
        cpn_client.connect_from_environment()


def test_faulty_files_are_named(secure: Secure, tmp_path: Path) -> None:
    faulty = tmp_path / "faulty.pem"
    faulty.write_text("no certificate")
    for tls in (
        Tls(tmp_path / "none.pem"),
        Tls(faulty),
        Tls(secure.tls.ca, certificate=faulty, private_key=secure.tls.private_key),
        Tls(secure.tls.ca, certificate=secure.tls.ca, private_key=secure.tls.private_key),
    ):
        for address in (secure.process.zenoh, secure.process.grpc):
            with pytest.raises(ValueError, match=f"^tls: expected an authority {tls.ca}, and a certificate "):
                cpn_client.connect(address, tls=tls)


def test_other_authority_is_unreachable(secure: Secure, tmp_path: Path) -> None:
    trustme.CA().cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    for address in (secure.process.zenoh, secure.process.grpc):
        with pytest.raises(UnreachableError):
            cpn_client.connect(address, tls=Tls(tmp_path / "ca.pem"), timeout_seconds=1.0)
    with pytest.raises(UnreachableError):
        cpn_client.connect(secure.process.zenoh, tls=Tls(secure.tls.ca), timeout_seconds=1.0)
