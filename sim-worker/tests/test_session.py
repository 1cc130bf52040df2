import json
import os
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import tyro
import zenoh

from cpn.v1 import demonstration_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.options import ServeConfig
from cpn_sim_worker.session import (
    MAX_MESSAGE_BYTES,
    ConfigError,
    LateError,
    NoRouterError,
    NotServedError,
    StoppedError,
    ZenohConfig,
    ask,
    is_connected,
    look_in,
    open_session,
    zenoh_config,
)
from tests.support import (
    COMMAND,
    READY_SECONDS,
    Log,
    assert_not_let_in,
    client,
    collect,
    free_endpoint,
    router,
    wait_for,
    wait_for_sample,
)

ANYWHERE = "tcp/0.0.0.0:7447"


def setting(config: ZenohConfig, key: str) -> object:
    return json.loads(zenoh_config(config).get_json(key))


def commit(session: zenoh.Session, episode: str, timeout_seconds: float) -> None:
    request = demonstration_pb2.CommitEpisodeRequest()
    key = keys.demonstration_commit(episode)
    ask(session, key, request, demonstration_pb2.CommitEpisodeResponse, timeout_seconds)


@pytest.fixture
def peers(session: zenoh.Session, endpoint: str) -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """Two peers that know only the endpoint of a third."""
    with ExitStack() as stack:
        config = ZenohConfig(connect=(endpoint,))
        yield stack.enter_context(open_session(config)), stack.enter_context(open_session(config))


def test_peers_reach_each_other_through_a_shared_endpoint(peers: tuple[zenoh.Session, zenoh.Session]) -> None:
    one, other = peers
    alive = other.liveliness().declare_subscriber(keys.planner_alive("p0"), collect(), history=True)
    token = one.liveliness().declare_token(keys.planner_alive("p0"))
    wait_for_sample(alive, zenoh.SampleKind.PUT)
    token.undeclare()
    wait_for_sample(alive, zenoh.SampleKind.DELETE)
    alive.undeclare()


def test_environment_variables_replace_missing_options(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("CA", "CERTIFICATE", "PRIVATE_KEY"):
        monkeypatch.setenv(f"CPN_TLS_{name}", str(tmp_path / name))
    monkeypatch.setenv("CPN_MODE", "client")
    monkeypatch.setenv("CPN_CONNECT", "tls/a:1, tls/b:2")
    monkeypatch.setenv("CPN_LISTEN", "tls/c:3")
    monkeypatch.setenv("CPN_NAMESPACE", "run")
    monkeypatch.setenv("CPN_USER", "somebody")
    monkeypatch.setenv("CPN_PASSWORD_FILE", "password")
    monkeypatch.setenv("ZENOH_CONFIG", "zenoh.json5")
    monkeypatch.setenv("CPN_INSECURE", "true")
    assert ZenohConfig() == ZenohConfig(
        mode="client",
        connect=("tls/a:1", "tls/b:2"),
        listen=("tls/c:3",),
        namespace="run",
        zenoh_config=Path("zenoh.json5"),
        user="somebody",
        password_file=Path("password"),
        tls_ca=tmp_path / "CA",
        tls_certificate=tmp_path / "CERTIFICATE",
        tls_private_key=tmp_path / "PRIVATE_KEY",
        insecure=True,
    )
    assert ZenohConfig(mode="peer", namespace=None, connect=("tcp/d:4,tcp/e:5",)).connect == ("tcp/d:4", "tcp/e:5")


def test_empty_variables_count_as_unset(monkeypatch: pytest.MonkeyPatch) -> None:
    unset = ZenohConfig()
    names = ("MODE", "CONNECT", "LISTEN", "NAMESPACE", "USER", "PASSWORD_FILE", "TLS_CA", "TLS_CERTIFICATE", "INSECURE")
    for variable in (*(f"CPN_{name}" for name in names), "CPN_TLS_PRIVATE_KEY", "ZENOH_CONFIG"):
        monkeypatch.setenv(variable, "")
    assert ZenohConfig() == unset
    assert setting(unset, "listen/endpoints") == {
        "router": ["tcp/127.0.0.1:0"],
        "peer": ["tcp/127.0.0.1:0"],
        "client": [],
    }


@pytest.mark.parametrize("text", ["None", "7", "true", "2024"])
def test_text_is_text_in_options_and_environment(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    options = ["--worker", text, "--namespace", text, "--user", text, "--password-file", text, "--zenoh-config", text]
    given = tyro.cli(ServeConfig, args=options, config=(tyro.conf.OmitArgPrefixes,))
    assert given.worker == text
    for variable in ("CPN_NAMESPACE", "CPN_USER", "CPN_PASSWORD_FILE", "ZENOH_CONFIG"):
        monkeypatch.setenv(variable, text)
    assert given.zenoh == ZenohConfig()
    assert (given.zenoh.namespace, given.zenoh.user, given.zenoh.password_file) == (text, text, Path(text))


def test_invalid_variable_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CPN_MODE", "broker")
    with pytest.raises(ConfigError, match="CPN_MODE: expected one of peer, client, router, got 'broker'"):
        ZenohConfig()
    run = subprocess.run([COMMAND, "serve"], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert run.stderr == "CPN_MODE: expected one of peer, client, router, got 'broker'\n"


@pytest.mark.parametrize(
    ("given", "missing"),
    [
        ({"user": "a"}, r"--password-file \(CPN_PASSWORD_FILE\): expected with --user"),
        ({"tls_ca": Path("a")}, r"--tls-certificate .*, --tls-private-key .*: expected with --tls-ca \(CPN_TLS_CA\)"),
    ],
)
def test_options_that_go_together(given: dict[str, object], missing: str) -> None:
    with pytest.raises(ConfigError, match=missing):
        ZenohConfig(**given)  # pyright: ignore[reportArgumentType]


def test_given_options_win_over_a_file_and_the_file_over_defaults(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("""{
        mode: "router", // as zenohd has it
        namespace: "file",
        connect: { endpoints: ["tcp/file:1"] },
        listen: { endpoints: { router: ["tls/0.0.0.0:1"], client: [] } },
        transport: { link: { rx: { max_message_size: 4096 } } },
    }""")
    assert setting(ZenohConfig(), "transport/link/rx/max_message_size") == MAX_MESSAGE_BYTES
    assert setting(ZenohConfig(), "scouting/multicast/enabled") is False

    alone = ZenohConfig(zenoh_config=file)
    assert setting(alone, "mode") == "router"
    assert setting(alone, "namespace") == "file"
    assert setting(alone, "transport/link/rx/max_message_size") == 4096
    assert setting(alone, "scouting/multicast/enabled") is None

    both = ZenohConfig(zenoh_config=file, mode="client", namespace="option", connect=("tcp/option:1",))
    assert setting(both, "mode") == "client"
    assert setting(both, "namespace") == "option"
    assert setting(both, "connect/endpoints") == ["tcp/option:1"]
    assert setting(both, "transport/link/rx/max_message_size") == 4096


@pytest.mark.parametrize(
    "endpoint",
    [ANYWHERE, "tcp/[::]:0", "tcp/192.0.2.1:1", "udp/0.0.0.0:1", "ws/0.0.0.0:1", "tcp/host:1", "tcp/0.0.0.0:1?rel=0"],
)
def test_plain_listening_beyond_the_loopback_is_refused(endpoint: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        zenoh_config(ZenohConfig(listen=("tcp/127.0.0.1:0", endpoint)))
    for part in ("--listen (CPN_LISTEN)", endpoint, "tls/", "--insecure (CPN_INSECURE)"):
        assert part in str(refusal.value)
    zenoh_config(ZenohConfig(listen=(endpoint,), insecure=True))


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1:0", "tcp/127.1.2.3:1", "tcp/[::1]:1", "tcp/localhost:1", "tls/0.0.0.0:1", "quic/[::]:1"]
)
def test_listening_on_the_loopback_or_with_tls_is_allowed(endpoint: str) -> None:
    zenoh_config(ZenohConfig(listen=(endpoint,)))


def test_listening_of_a_file_is_held_to_the_same(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("{}")
    with pytest.raises(ConfigError, match=r"got tcp/\[::\]:0"):
        zenoh_config(ZenohConfig(zenoh_config=file))
    zenoh_config(ZenohConfig(zenoh_config=file, listen=("tcp/127.0.0.1:0",)))
    # By zenoh's defaults a client does not listen.
    zenoh_config(ZenohConfig(zenoh_config=file, mode="client", connect=("tcp/127.0.0.1:1",)))


def test_worker_that_would_listen_beyond_the_loopback_does_not_start() -> None:
    run = subprocess.run([COMMAND, "serve", "--listen", ANYWHERE], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert f"or --insecure (CPN_INSECURE), got {ANYWHERE}" in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "client"}, r"--connect \(CPN_CONNECT\): expected the endpoint of a router"),
        ({"connect": ("7447",)}, r"--connect \(CPN_CONNECT\): Endpoints must be of the form"),
        ({"namespace": "a/**"}, r"--namespace \(CPN_NAMESPACE\): .*wild"),
        ({"zenoh_config": Path("/missing.json5")}, r"--zenoh-config \(ZENOH_CONFIG\): .* got /missing\.json5: No such"),
        ({"user": "a", "password_file": Path("/")}, r"--password-file \(CPN_PASSWORD_FILE\): .* got /: Is a dir"),
    ],
)
def test_invalid_option_is_named(options: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        zenoh_config(ZenohConfig(**options))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("text", ["{ mode: ", '{ "nonsense": 1 }'])
def test_malformed_file_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"--zenoh-config \(ZENOH_CONFIG\).*zenoh\.json5: "):
        zenoh_config(ZenohConfig(zenoh_config=file))


def test_missing_answers_have_distinct_errors() -> None:
    endpoint = free_endpoint()
    held: list[zenoh.Query] = []
    with ExitStack() as stack:
        routing = stack.enter_context(ExitStack())
        routing.enter_context(open_session(router(endpoint)))
        service = stack.enter_context(open_session(client(endpoint)))
        asking = stack.enter_context(open_session(client(endpoint)))
        with pytest.raises(NotServedError, match="nobody/commit: nobody serves it"):
            commit(asking, "nobody", READY_SECONDS)
        service.declare_queryable(keys.demonstration_commit("silent"), held.append)
        wait_for(lambda: list(asking.get(keys.demonstration_commit("silent"), timeout=0.1)))
        with pytest.raises(LateError, match=r"silent/commit within 0\.5 s"):
            commit(asking, "silent", 0.5)
        held.clear()
        routing.close()
        wait_for(lambda: not is_connected(asking))
        with pytest.raises(NoRouterError, match="silent/commit: no router or peer is connected"):
            commit(asking, "silent", READY_SECONDS)


@pytest.mark.usefixtures("quick")
def test_client_waits_for_its_router_with_warnings(session_log: Log) -> None:
    endpoint = free_endpoint()
    joined, done = threading.Event(), threading.Event()

    def join() -> None:
        with open_session(client(endpoint)):
            joined.set()
            done.wait()

    thread = threading.Thread(target=join)
    thread.start()
    try:
        wait_for(
            lambda: session_log.says(f"no router answers at {endpoint}: {endpoint}: [Errno 111] Connection refused")
        )
        assert not joined.is_set()
        with open_session(router(endpoint)):
            assert joined.wait(READY_SECONDS)
    finally:
        done.set()
        thread.join()


@pytest.mark.usefixtures("quick")
def test_loss_of_the_router_is_logged_and_so_is_its_return(session_log: Log) -> None:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        with open_session(router(endpoint)):
            session = stack.enter_context(open_session(client(endpoint)))
        wait_for(lambda: session_log.says("no router or peer is connected"))
        assert not session_log.says("connected to the zenoh network again")
        with open_session(router(endpoint)):
            wait_for(lambda: session_log.says("connected to the zenoh network again"))
            assert is_connected(session)


def test_client_uses_the_available_router(session_log: Log) -> None:
    missing, endpoint = free_endpoint(), free_endpoint()
    with open_session(router(endpoint)), open_session(client(missing, endpoint)) as session:
        assert is_connected(session)
    assert not session_log.says("no router answers")


def test_wait_for_a_router_can_be_stopped_and_bounded() -> None:
    stop = threading.Event()
    stop.set()
    endpoint = free_endpoint()
    with pytest.raises(StoppedError, match=endpoint), open_session(client(endpoint), stop):
        pass
    with pytest.raises(NoRouterError, match=endpoint), look_in(client(endpoint), patience_seconds=0.2):
        pass


@pytest.mark.parametrize("silent", [False, True])
def test_sigterm_ends_a_worker_that_waits_for_its_router(silent: bool) -> None:
    """The endpoint is closed, or open and silent."""
    with socket.socket() as listener:
        endpoint = free_endpoint()
        if silent:
            listener.bind(("127.0.0.1", 0))
            listener.listen()
            endpoint = f"tcp/127.0.0.1:{listener.getsockname()[1]}"
        command = [COMMAND, "serve", "--mode", "client", "--connect", endpoint]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            assert any(f"no router answers at {endpoint}" in line for line in process.stderr)
            os.kill(process.pid, signal.SIGTERM)
            assert process.wait(timeout=READY_SECONDS) == 0


def test_declarations_outlive_the_router() -> None:
    endpoint = free_endpoint()

    def answer(query: zenoh.Query) -> None:
        with query:
            response = demonstration_pb2.CommitEpisodeResponse()
            query.reply(keys.demonstration_commit("e"), response.SerializeToString())

    with ExitStack() as stack:
        with open_session(router(endpoint)):
            service = stack.enter_context(open_session(client(endpoint)))
            asking = stack.enter_context(open_session(client(endpoint)))
            queryable = service.declare_queryable(keys.demonstration_commit("e"), answer, complete=True)
            token = service.liveliness().declare_token(keys.planner_alive("p"))
        wait_for(lambda: not is_connected(asking) and not is_connected(service))
        with open_session(router(endpoint)):
            wait_for(lambda: is_connected(asking) and is_connected(service))
            wait_for(lambda: list(asking.liveliness().get(keys.planner_alive("p"), timeout=READY_SECONDS)))
            commit(asking, "e", READY_SECONDS)
            token.undeclare()
            queryable.undeclare()


def test_namespaces_are_kept_apart() -> None:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        stack.enter_context(open_session(router(endpoint)))
        one, same, other = (
            stack.enter_context(open_session(ZenohConfig(mode="client", connect=(endpoint,), namespace=namespace)))
            for namespace in ("one", "one", "other")
        )
        token = one.liveliness().declare_token(keys.planner_alive("p"))
        wait_for(lambda: list(same.liveliness().get(keys.planner_alive("p"), timeout=READY_SECONDS)))
        assert not list(other.liveliness().get(keys.planner_alive("p"), timeout=READY_SECONDS))
        token.undeclare()


@pytest.mark.usefixtures("quick")
def test_user_and_password(tmp_path: Path, session_log: Log) -> None:
    dictionary, password, wrong = (tmp_path / name for name in ("dictionary", "password", "wrong"))
    dictionary.write_text("somebody:secret\n")
    password.write_text("secret\n")
    wrong.write_text("guess\n")
    file = tmp_path / "router.json5"
    file.write_text(json.dumps({"transport": {"auth": {"usrpwd": {"dictionary_file": str(dictionary)}}}}))
    endpoint = free_endpoint()

    def somebody(password_file: Path) -> ZenohConfig:
        return ZenohConfig(mode="client", connect=(endpoint,), user="somebody", password_file=password_file)

    with open_session(ZenohConfig(mode="router", listen=(endpoint,), zenoh_config=file)):
        with open_session(somebody(password)) as session:
            assert is_connected(session)
        for stranger in (somebody(wrong), client(endpoint)):
            assert_not_let_in(stranger, session_log, "it may ask for TLS, or for a user")
