"""Mutual TLS between sessions, with certificates of an authority made for the test."""

import json
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import trustme
import zenoh

from cpn.v1 import demonstration_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.session import (
    ConfigError,
    Mode,
    ZenohConfig,
    ask,
    is_connected,
    open_session,
    zenoh_config,
)
from tests.support import READY_SECONDS, Log, assert_not_let_in, free_endpoint, wait_for

pytestmark = pytest.mark.usefixtures("quick")


class Authority:
    """Certificate authority, with a folder of issued certificates."""

    def __init__(self, folder: Path) -> None:
        self._authority = trustme.CA(organization_name=folder.name)
        self._folder = folder
        folder.mkdir()
        self.certificate = folder / "ca.pem"
        self._authority.cert_pem.write_to_path(self.certificate)

    def issue(self, name: str, host: str = "localhost", *, expired: bool = False) -> tuple[Path, Path]:
        """Issues a certificate with its key."""
        end = datetime.now(UTC) + timedelta(days=-1 if expired else 1)
        issued = self._authority.issue_cert(host, common_name=name, not_before=end - timedelta(days=2), not_after=end)
        certificate, private_key = self._folder / f"{name}.pem", self._folder / f"{name}.key"
        for number, blob in enumerate(issued.cert_chain_pems):
            blob.write_to_path(certificate, append=number > 0)
        issued.private_key_pem.write_to_path(private_key)
        return certificate, private_key


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority(tmp_path / "ours")


@pytest.fixture
def endpoint() -> str:
    return free_endpoint("tls", "localhost")


def member(mode: Mode, endpoint: str, authority: Authority, files: tuple[Path, Path]) -> ZenohConfig:
    return ZenohConfig(
        mode=mode,
        connect=(endpoint,) if mode == "client" else (),
        listen=(endpoint,) if mode == "router" else (),
        tls_ca=authority.certificate,
        tls_certificate=files[0],
        tls_private_key=files[1],
    )


def test_members_talk_over_mutual_tls(authority: Authority, endpoint: str) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            response = demonstration_pb2.CommitEpisodeResponse(missing_steps=[7])
            query.reply(keys.demonstration_commit("e"), response.SerializeToString())

    with (
        open_session(member("router", endpoint, authority, authority.issue("router"))),
        open_session(member("client", endpoint, authority, authority.issue("trainer"))) as trainer,
        open_session(member("client", endpoint, authority, authority.issue("worker"))) as worker,
    ):
        queryable = trainer.declare_queryable(keys.demonstration_commit("e"), answer, complete=True)
        request, response_type = demonstration_pb2.CommitEpisodeRequest(), demonstration_pb2.CommitEpisodeResponse
        wait_for(lambda: list(worker.get(keys.demonstration_commit("e"), timeout=READY_SECONDS)))
        response = ask(worker, keys.demonstration_commit("e"), request, response_type, READY_SECONDS)
        assert response.missing_steps == [7]
        queryable.undeclare()


def test_clients_without_a_valid_certificate_are_refused(
    authority: Authority, endpoint: str, tmp_path: Path, session_log: Log
) -> None:
    others = Authority(tmp_path / "others")
    nameless = tmp_path / "nameless.json5"
    tls = {"root_ca_certificate": str(authority.certificate)}
    nameless.write_text(json.dumps({"transport": {"link": {"tls": tls}}}))
    with open_session(member("router", endpoint, authority, authority.issue("router"))) as router:
        without = ZenohConfig(mode="client", connect=(endpoint,), zenoh_config=nameless)
        assert_not_let_in(without, session_log, "alert certificate required")
        # The authority's certificate is public; a client needs one of its own.
        foreign = member("client", endpoint, authority, others.issue("worker"))
        assert_not_let_in(foreign, session_log, "alert unknown ca")
        late = member("client", endpoint, authority, authority.issue("late", expired=True))
        assert_not_let_in(late, session_log, "alert certificate expired")
        plain = ZenohConfig(mode="client", connect=(endpoint.replace("tls/", "tcp/"),))
        assert_not_let_in(plain, session_log, "it may ask for TLS")
        assert not router.info.transports()


@pytest.mark.parametrize(
    ("name", "host", "expired", "reason"),
    [
        ("stranger", "localhost", False, "unable to get local issuer certificate"),
        ("router", "elsewhere", False, "Hostname mismatch"),
        ("router", "localhost", True, "certificate has expired"),
    ],
)
def test_router_that_cannot_prove_its_name_is_not_joined(
    name: str,
    host: str,
    expired: bool,
    reason: str,
    authority: Authority,
    endpoint: str,
    tmp_path: Path,
    session_log: Log,
) -> None:
    others = Authority(tmp_path / "others")
    files = (others if name == "stranger" else authority).issue(name, host, expired=expired)
    with open_session(member("router", endpoint, authority, files)):
        assert_not_let_in(member("client", endpoint, authority, authority.issue("worker")), session_log, reason)


def test_router_without_tls_is_not_joined(authority: Authority, endpoint: str, session_log: Log) -> None:
    with open_session(ZenohConfig(mode="router", listen=(endpoint.replace("tls/", "tcp/"),))) as router:
        client = member("client", endpoint, authority, authority.issue("worker"))
        assert_not_let_in(client, session_log, f"no router answers at {endpoint}")
        assert not router.info.transports()


def test_client_reconnects_to_a_router_over_tls(authority: Authority, endpoint: str, session_log: Log) -> None:
    routing = member("router", endpoint, authority, authority.issue("router"))
    with ExitStack() as stack:
        with open_session(routing):
            client = stack.enter_context(open_session(member("client", endpoint, authority, authority.issue("worker"))))
        wait_for(lambda: session_log.says("no router or peer is connected"))
        with open_session(routing):
            wait_for(lambda: is_connected(client))


def test_invalid_files_are_refused_before_connecting(authority: Authority, endpoint: str, tmp_path: Path) -> None:
    certificate, private_key = authority.issue("worker")
    _, another_key = authority.issue("another")
    garbage = tmp_path / "garbage.pem"
    garbage.write_text("garbage")
    with pytest.raises(ConfigError, match=r"--tls-private-key \(CPN_TLS_PRIVATE_KEY\): .*missing\.key: No such file"):
        zenoh_config(member("client", endpoint, authority, (certificate, tmp_path / "missing.key")))
    for files in ((certificate, another_key), (garbage, private_key), (certificate, garbage)):
        with pytest.raises(ConfigError, match=r"--tls-certificate \(CPN_TLS_CERTIFICATE\) .*, got "):
            zenoh_config(member("client", endpoint, authority, files))
    authority.certificate.write_text("garbage")
    with pytest.raises(ConfigError, match=r"--tls-ca \(CPN_TLS_CA\) .*, got "):
        zenoh_config(member("client", endpoint, authority, (certificate, private_key)))
