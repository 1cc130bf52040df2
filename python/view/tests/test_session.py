from pathlib import Path

import pytest
import zenoh

from cpn_view.error import ViewError
from cpn_view.session import ZenohConfig, open_session
from tests.support import free_port, wait_for

NOBODY = "tcp/127.0.0.1:1"


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({}, r"--connect \(CPN_CONNECT\): expected an endpoint of the network, got none"),
        ({"connect": NOBODY, "mode": "router"}, r"--mode \(CPN_MODE\): expected peer or client, got 'router'"),
        ({"connect": NOBODY, "mode": "client"}, f"zenoh: expected a network at {NOBODY}, got "),
        ({"connect": "nowhere"}, "zenoh: expected a network at nowhere, got "),
        ({"connect": NOBODY, "user": "me"}, "--user, --password-file .* expected both or none, got one"),
        ({"connect": NOBODY, "tls_ca": Path(__file__)}, "--tls-ca, .* expected all or none, got some"),
        (
            {"connect": NOBODY, "user": "me", "password_file": Path("none.txt")},
            "--password-file: expected a file that can be read, got .*none.txt",
        ),
        ({"zenoh_config": Path("none.json5")}, "--zenoh-config: expected a file that can be read, got .*none.json5"),
    ],
)
def test_wrong_options(options: dict[str, object], error: str) -> None:
    with pytest.raises(ViewError, match=error):
        open_session(ZenohConfig(**options))  # pyright: ignore[reportArgumentType]


def test_faulty_certificates(tmp_path: Path) -> None:
    (file := tmp_path / "file.pem").write_text("no certificate")
    with pytest.raises(ViewError, match="--tls-private-key: expected an authority, a certificate and its key, got "):
        open_session(ZenohConfig(connect="tls/127.0.0.1:1", tls_ca=file, tls_certificate=file, tls_private_key=file))


def test_options_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CPN_CONNECT", "tcp/a:1, tcp/b:2")
    monkeypatch.setenv("CPN_NAMESPACE", "run")
    monkeypatch.setenv("CPN_TLS_CA", "")
    options = ZenohConfig()
    assert options.endpoints == ["tcp/a:1", "tcp/b:2"]
    assert (options.namespace, options.tls_ca) == ("run", None)


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_joins_and_does_not_listen(mode: str) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    with zenoh.open(config), open_session(ZenohConfig(mode=mode, connect=endpoint)) as session:
        wait_for(lambda: session.info.routers_zid())


def test_peer_waits_for_its_network() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    with open_session(ZenohConfig(connect=endpoint)) as session, zenoh.open(config):
        wait_for(lambda: session.info.peers_zid())
