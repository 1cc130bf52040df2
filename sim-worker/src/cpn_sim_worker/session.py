"""Zenoh sessions: configuration, opening, monitoring of the connection, and requests to services."""

import ipaddress
import json
import logging
import os
import re
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, cast, get_args

import tyro
import zenoh
from google.protobuf.message import Message

from cpn.v1 import types_pb2
from cpn_sim_worker.wire import RequestError, decode, encoding

log = logging.getLogger(__name__)

M = TypeVar("M", bound=Message)
T = TypeVar("T")

Mode = Literal["peer", "client", "router"]


def _default_hint(default: str) -> str:
    """Default in an option's help, which tyro would write as a list of one."""
    return f"(default: {default.strip('[]').strip(chr(39))})"


# With constructors of their own, since tyro would parse a namespace called "None" as no namespace.
Text = Annotated[str | None, tyro.conf.arg(constructor=str, help_behavior_hint=_default_hint)]
File = Annotated[Path | None, tyro.conf.arg(constructor=Path, help_behavior_hint=_default_hint)]

MAX_MESSAGE_BYTES = 16 << 20
"""Largest message after defragmentation. Zenoh's default is 1 GiB."""
REMINDER_SECONDS = 5.0
"""Interval of the warning that nothing is connected."""
RETRY_SECONDS = 1.0
"""Longest pause between two tries to connect."""
CHECK_SECONDS = 0.5
"""Interval of checks of the connection."""
POLL_SECONDS = 0.1
"""Interval at which the signal to stop is checked during the wait for a router."""
PROBE_SECONDS = 1.0
"""Timeout of each step of an endpoint's probe."""


class ConfigError(ValueError):
    """Invalid option or environment variable."""


class UnavailableError(Exception):
    """No answer; a later retry may succeed."""


class NoRouterError(UnavailableError):
    """No router or peer is connected."""


class NotServedError(UnavailableError):
    """The network is connected, but no service has the key."""


class LateError(UnavailableError):
    """No answer came in time."""


class StoppedError(Exception):
    """The wait for a router was cancelled."""


def _from_environment(variable: str, read: Callable[[str], T], otherwise: T) -> Callable[[], T]:
    """Default factory that reads an environment variable; an empty one counts as unset."""

    def default() -> T:
        text = os.environ.get(variable)
        return read(text) if text else otherwise

    return default


def _mode(text: str) -> Mode:
    if text not in get_args(Mode):
        raise ConfigError(f"CPN_MODE: expected one of {', '.join(get_args(Mode))}, got {text!r}")
    return cast(Mode, text)


def _split(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _boolean(text: str) -> bool:
    return text.lower() not in ("0", "n", "no", "f", "false", "off")


@dataclass(frozen=True)
class ZenohConfig:
    """Joining a zenoh network. Environment variables stand in for options that are not given."""

    mode: Mode | None = field(default_factory=_from_environment("CPN_MODE", _mode, None))
    """Zenoh mode: peer (the default) connects to other peers directly, client to one router, router passes messages
    on. CPN_MODE."""
    connect: tuple[str, ...] = field(default_factory=_from_environment("CPN_CONNECT", _split, ()))
    """Endpoints to connect to, for example tcp/127.0.0.1:7447 or tls/router:7447. Peers that share one find each other
    by gossip. CPN_CONNECT, separated by commas."""
    listen: tuple[str, ...] = field(default_factory=_from_environment("CPN_LISTEN", _split, ()))
    """Endpoints to listen on; by default any free port of the loopback interface, and none for a client. CPN_LISTEN,
    separated by commas."""
    namespace: Text = field(default_factory=_from_environment("CPN_NAMESPACE", str, None))
    """Prefix of every key, which separates runs that share a network. CPN_NAMESPACE."""
    zenoh_config: File = field(default_factory=_from_environment("ZENOH_CONFIG", Path, None))
    """Zenoh configuration file (.json5, .json or .yaml), in place of the defaults here; options on the command line win
    over it. ZENOH_CONFIG."""
    user: Text = field(default_factory=_from_environment("CPN_USER", str, None))
    """User name for routers that ask for one. CPN_USER."""
    password_file: File = field(default_factory=_from_environment("CPN_PASSWORD_FILE", Path, None))
    """File with the user's password. CPN_PASSWORD_FILE."""
    tls_ca: File = field(default_factory=_from_environment("CPN_TLS_CA", Path, None))
    """Certificate of the network's authority, in PEM. CPN_TLS_CA."""
    tls_certificate: File = field(default_factory=_from_environment("CPN_TLS_CERTIFICATE", Path, None))
    """Certificate of this process, in PEM, for connections of either direction. CPN_TLS_CERTIFICATE."""
    tls_private_key: File = field(default_factory=_from_environment("CPN_TLS_PRIVATE_KEY", Path, None))
    """Private key of the certificate, in PEM. CPN_TLS_PRIVATE_KEY."""
    insecure: bool = field(default_factory=_from_environment("CPN_INSECURE", _boolean, False))
    """Listen beyond the loopback interface without TLS. CPN_INSECURE."""

    def __post_init__(self) -> None:
        for name in ("connect", "listen"):
            endpoints = tuple(endpoint for value in getattr(self, name) for endpoint in _split(value))
            object.__setattr__(self, name, endpoints)
        _require_together(self, "user", "password_file")
        _require_together(self, "tls_ca", "tls_certificate", "tls_private_key")


def _require_together(config: ZenohConfig, *names: str) -> None:
    missing = [name for name in names if getattr(config, name) is None]
    if 0 < len(missing) < len(names):
        given = " and ".join(_option(name) for name in names if name not in missing)
        raise ConfigError(f"{', '.join(_option(name) for name in missing)}: expected with {given}, got none")


def _option(name: str) -> str:
    """Names of an option on the command line and in the environment."""
    variable = "ZENOH_CONFIG" if name == "zenoh_config" else f"CPN_{name.upper()}"
    return f"--{name.replace('_', '-')} ({variable})"


def zenoh_config(options: ZenohConfig) -> zenoh.Config:
    """Zenoh configuration of a session.

    Raises:
        ConfigError: If an option is malformed, a file cannot be used, an endpoint listens beyond the loopback interface
            without TLS, or a client has nothing to connect to.
    """
    config = _defaults() if options.zenoh_config is None else _own_config(options.zenoh_config)

    if options.mode is not None:
        _set(config, "mode", options.mode)
    for name in ("connect", "listen"):
        if endpoints := getattr(options, name):
            _set(config, f"{name}/endpoints", endpoints, _option(name))
    if options.namespace is not None:
        _set(config, "namespace", options.namespace, _option("namespace"))
    if options.user is not None and options.password_file is not None:
        password = _read("password_file", options.password_file).rstrip("\r\n")
        if not password:
            raise ConfigError(f"{_option('password_file')}: expected a password, got an empty {options.password_file}")
        _set(config, "transport/auth/usrpwd/user", options.user, _option("user"))
        _set(config, "transport/auth/usrpwd/password", password)

    if options.tls_ca is not None and options.tls_certificate is not None and options.tls_private_key is not None:
        _set_tls(config, options.tls_ca, options.tls_certificate, options.tls_private_key)
    _check_endpoints(config, insecure=options.insecure)
    return config


def _defaults() -> zenoh.Config:
    """Zenoh's defaults with shorter pauses, and without multicast, which fails silently in containers."""
    config = zenoh.Config()
    _set(config, "scouting/multicast/enabled", value=False)
    _set(config, "scouting/gossip/enabled", value=True)
    retry = {"period_init_ms": 200, "period_max_ms": int(1000 * RETRY_SECONDS), "period_increase_factor": 2}
    _set(config, "connect/retry", retry)
    any_port = ["tcp/127.0.0.1:0"]
    _set(config, "listen/endpoints", {"peer": any_port, "router": any_port, "client": []})
    _set(config, "transport/link/rx/max_message_size", MAX_MESSAGE_BYTES)
    return config


def _own_config(path: Path) -> zenoh.Config:
    _read("zenoh_config", path)
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        raise ConfigError(f"{_option('zenoh_config')} {path}: {_text(error)}") from None


def _set_tls(config: zenoh.Config, ca: Path, certificate: Path, private_key: Path) -> None:
    for name, path in (("tls_ca", ca), ("tls_certificate", certificate), ("tls_private_key", private_key)):
        _read(name, path)
    # Checked here, since zenoh reports a faulty file only as a router that does not answer.
    try:
        _tls_context(str(ca), str(certificate), str(private_key))
    except OSError as error:
        files = f"{_option('tls_ca')} {ca}, {_option('tls_certificate')} {certificate}, {_option('tls_private_key')}"
        raise ConfigError(
            f"{files} {private_key}: expected an authority, a certificate and its key, got {error}"
        ) from None
    settings = {
        "root_ca_certificate": str(ca),
        "listen_certificate": str(certificate),
        "listen_private_key": str(private_key),
        "connect_certificate": str(certificate),
        "connect_private_key": str(private_key),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    for key, value in settings.items():
        _set(config, f"transport/link/tls/{key}", value)

    # A single thread, since zenoh's TLS links read and write one stream from two threads at once, which corrupts memory
    # sooner or later (eclipse-zenoh/zenoh#2557). Zenoh reads this when its first session is opened.
    os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1), tx: (handover: rx))")


def _check_endpoints(config: zenoh.Config, *, insecure: bool) -> None:
    multicast = _get(config, "scouting/multicast/enabled") is not False
    if _mode_of(config) == "client" and not _endpoints(config, "connect") and not multicast:
        raise ConfigError(f"{_option('connect')}: expected the endpoint of a router, as the mode is client, got none")
    for endpoint in _endpoints(config, "listen"):
        if not (insecure or _is_private(endpoint)):
            raise ConfigError(
                f"{_option('listen')}: expected a tls/ endpoint beyond the loopback interface, or --insecure "
                f"(CPN_INSECURE), got {endpoint}"
            )


def _is_private(endpoint: str) -> bool:
    """Whether the endpoint is encrypted, or unreachable from other machines."""
    protocol, address = _parts(endpoint)
    if protocol in ("tls", "quic") or protocol.startswith("unix"):
        return True
    host, _ = _host_and_port(address)
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def _parts(endpoint: str) -> tuple[str, str]:
    protocol, _, address = endpoint.partition("/")
    return protocol, re.split("[?#]", address, maxsplit=1)[0]


def _host_and_port(address: str) -> tuple[str, str]:
    host, _, port = address.rpartition(":")
    return host.removeprefix("[").removesuffix("]"), port


def _read(name: str, path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no text"
        raise ConfigError(f"{_option(name)}: expected a file that can be read, got {path}: {reason}") from None


def _set(config: zenoh.Config, key: str, value: object, option: str | None = None) -> None:
    try:
        config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise ConfigError(f"{option or key}: {_text(error)}") from None


def _get(config: zenoh.Config, key: str) -> Any:  # noqa: ANN401
    return json.loads(config.get_json(key))


def _mode_of(config: zenoh.Config) -> Mode:
    return _get(config, "mode") or "peer"


def _endpoints(config: zenoh.Config, direction: Literal["connect", "listen"]) -> list[str]:
    """Endpoints of the session's mode. Zenoh has one list for all modes or one for each, with optional groups."""
    value = _get(config, f"{direction}/endpoints")
    if isinstance(value, dict):
        value = value.get(_mode_of(config))
    groups = [entry["locators"] if isinstance(entry, dict) else [entry] for entry in value or []]
    return [endpoint for group in groups for endpoint in group]


def _text(error: zenoh.ZError) -> str:
    """Message of a zenoh error, without positions in its sources and in the value."""
    text = re.sub(r"\s+at /\S+\.rs:\d+\.?", "", str(error))
    message = re.search(r'msg: "(.*)", location', text)
    return message[1] if message else text


@contextmanager
def open_session(options: ZenohConfig, stop: threading.Event | None = None) -> Iterator[zenoh.Session]:
    """Session that keeps trying to reach its endpoints, so that services may start in any order.

    A client waits for its router, in the main thread interruptible by signals; a peer or router does not wait. While no
    endpoint is connected, a warning every few seconds gives the reason.

    Args:
        options: Settings of the session.
        stop: Event that cancels a client's wait.

    Raises:
        ConfigError: If an option is invalid.
        StoppedError: If `stop` was set before a router answered.
        zenoh.ZError: If an endpoint cannot be listened on.
    """
    config = zenoh_config(options)
    network = _Network(config)
    with _open(config, network, stop or threading.Event()) as session:
        watch = _Watch(session, network)
        try:
            yield session
        finally:
            watch.close()


@contextmanager
def look_in(options: ZenohConfig, patience_seconds: float) -> Iterator[zenoh.Session]:
    """Session beside a service with the same options: it connects to the same endpoints, and does not listen.

    Raises:
        ConfigError: If an option is invalid.
        NoRouterError: If a client reached no router in time.
    """
    config = zenoh_config(options)
    if _mode_of(config) == "router":
        _set(config, "mode", "client")
    # A service that only listens is reached at its own endpoint.
    endpoints = _endpoints(config, "connect") or _endpoints(config, "listen")
    if all(_parts(endpoint)[1].endswith(":0") for endpoint in endpoints):
        raise ConfigError(f"{_option('connect')}: expected an endpoint of the network, got none")
    _set(config, "connect/endpoints", endpoints)
    _set(config, "listen/endpoints", [])
    with _open(config, _Network(config), threading.Event(), patience_seconds) as session:
        yield session


@contextmanager
def _open(
    config: zenoh.Config, network: "_Network", stop: threading.Event, patience_seconds: float | None = None
) -> Iterator[zenoh.Session]:
    if _mode_of(config) == "client":
        session = _wait_for_router(config, network, stop, patience_seconds)
    else:
        session = zenoh.open(config)
    with session:
        yield session


class _Network:
    """Endpoints of a session, with a diagnosis of failures: zenoh reports only that it reached none."""

    def __init__(self, config: zenoh.Config) -> None:
        self.endpoints = _endpoints(config, "connect")
        tls = _get(config, "transport/link/tls")
        self._tls = (tls["root_ca_certificate"], tls["connect_certificate"], tls["connect_private_key"])

    def __str__(self) -> str:
        return ", ".join(self.endpoints) or "any address"

    def fault(self) -> str:
        """Reasons why no endpoint is connected, by a probe of each."""
        return "; ".join(f"{endpoint}: {self._probe(endpoint)}" for endpoint in self.endpoints)

    def _probe(self, endpoint: str) -> str:
        protocol, address = _parts(endpoint)
        host, port = _host_and_port(address)
        if protocol not in ("tcp", "tls") or not port.isdecimal():
            return "no answer"
        try:
            with socket.create_connection((host, int(port)), PROBE_SECONDS) as connection:
                if protocol == "tls":
                    context = _tls_context(*self._tls)
                    with context.wrap_socket(connection, server_hostname=host) as encrypted, suppress(TimeoutError):
                        # A server that refuses the client's certificate says so after the handshake, else it is silent.
                        encrypted.recv(1)
        except TimeoutError:
            return "no answer in time"
        except OSError as error:
            return str(error)
        return f"{protocol} connects, but the other side refuses a zenoh session: it may ask for TLS, or for a user"


def _tls_context(ca: str | None, certificate: str | None, private_key: str | None) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=ca)
    if certificate is not None:
        # An empty password, since OpenSSL would prompt on the terminal.
        context.load_cert_chain(certificate, private_key, password="")
    return context


class _Opening:
    """Tries to reach a router, on a thread of its own, because `zenoh.open` blocks signals."""

    def __init__(self, config: zenoh.Config, network: _Network) -> None:
        self.fault = "no answer yet"
        self.done = threading.Event()
        self._config = config
        self._network = network
        self._session: zenoh.Session | None = None
        self._lock = threading.Lock()
        self._given_up = threading.Event()
        threading.Thread(target=self._run, name="zenoh-open", daemon=True).start()

    def _run(self) -> None:
        # Each try goes through all endpoints; with a retry of its own, zenoh would stay with the first.
        last_probe = -REMINDER_SECONDS
        while not self._given_up.is_set():
            try:
                session = zenoh.open(self._config)
            except zenoh.ZError as error:
                if time.monotonic() - last_probe >= REMINDER_SECONDS:
                    last_probe = time.monotonic()
                    self.fault = self._network.fault() or _text(error)
                self._given_up.wait(RETRY_SECONDS)
                continue
            with self._lock:
                if not self._given_up.is_set():
                    self._session = session
                    self.done.set()
                    return
            session.close()

    def take(self) -> zenoh.Session | None:
        """Ends the tries; returns the session if it is open."""
        with self._lock:
            self._given_up.set()
            return self._session


def _wait_for_router(
    config: zenoh.Config, network: _Network, stop: threading.Event, patience_seconds: float | None
) -> zenoh.Session:
    start = reminded = time.monotonic()
    opening = _Opening(config, network)
    while not opening.done.wait(POLL_SECONDS) and not stop.is_set():
        now = time.monotonic()
        if patience_seconds is not None and now - start >= patience_seconds:
            break
        if now - reminded >= REMINDER_SECONDS:
            reminded = now
            log.warning("no router answers at %s: %s; trying again", network, opening.fault)
    session = opening.take()
    if session is None and stop.is_set():
        raise StoppedError(f"stopped before a router answered at {network}")
    if session is None:
        raise NoRouterError(f"no router answers at {network}: {opening.fault}")
    return session


def is_connected(session: zenoh.Session) -> bool:
    """Whether a router or a peer is connected."""
    return bool(session.info.routers_zid() or session.info.peers_zid())


class _Watch:
    """Monitor that warns while a session with endpoints has no connection."""

    def __init__(self, session: zenoh.Session, network: _Network) -> None:
        self._session = session
        self._network = network
        self._lock = threading.Lock()
        self._closed = threading.Event()
        if network.endpoints:
            threading.Thread(target=self._run, name="zenoh-watch", daemon=True).start()

    def _run(self) -> None:
        reminded = None
        while not self._closed.wait(CHECK_SECONDS):
            with self._lock:
                if self._closed.is_set():
                    return
                connected = is_connected(self._session)
            if connected and reminded is not None:
                reminded = None
                log.info("connected to the zenoh network again")
            elif not connected and (reminded is None or time.monotonic() - reminded >= REMINDER_SECONDS):
                reminded = time.monotonic()
                fault = self._network.fault()
                if not self._closed.is_set():
                    log.warning("no router or peer is connected: %s; trying again", fault)

    def close(self) -> None:
        """Ends the monitor. The lock keeps its thread out of zenoh at the interpreter's shutdown, which would abort."""
        with self._lock:
            self._closed.set()


def ask(session: zenoh.Session, key: str, request: Message, response_type: type[M], timeout_seconds: float) -> M:
    """Sends a request to the service at `key`.

    Raises:
        NoRouterError: If no reply came, and no router or peer is connected.
        NotServedError: If no service has the key.
        LateError: If no reply came in time.
        RequestError: If the service refused the request.
    """
    replies = session.get(
        key, payload=request.SerializeToString(), encoding=encoding(type(request)), timeout=timeout_seconds
    )
    late = False
    for reply in replies:
        if reply.ok is not None:
            return decode(response_type, reply.ok.payload.to_bytes())
        # zenoh reports its own timeouts as error replies too, in another encoding.
        if reply.err is not None and str(reply.err.encoding) == encoding(types_pb2.Error):
            raise RequestError.from_proto(decode(types_pb2.Error, reply.err.payload.to_bytes()))
        late = True
    if not is_connected(session):
        raise NoRouterError(f"no reply on {key}: no router or peer is connected")
    if late:
        raise LateError(f"no reply on {key} within {timeout_seconds} s")
    raise NotServedError(f"no reply on {key}: nobody serves it")
