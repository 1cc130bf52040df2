"""Zenoh session of a watcher, which connects and never listens."""

import json
import os
import re
import ssl
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from cpn_view.error import ViewError

MAX_MESSAGE_BYTES = 2 << 20
"""Largest message after defragmentation: that of a worker, 1 MiB, with a margin for its head."""
RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
"""Pauses between attempts to connect."""


def _text(variable: str) -> Callable[[], str]:
    """Default factory that reads an environment variable."""
    return lambda: os.environ.get(variable, "")


def _file(variable: str) -> Callable[[], Path | None]:
    """Default factory that reads a path from an environment variable; an empty one counts as unset."""
    return lambda: Path(os.environ[variable]) if os.environ.get(variable) else None


@dataclass(frozen=True)
class ZenohConfig:
    """Joining a zenoh network. Environment variables stand in for options that are not given."""

    mode: str = field(default_factory=_text("CPN_MODE"))
    """Zenoh mode: peer (the default) connects to other peers directly, client to one router. CPN_MODE."""
    connect: str = field(default_factory=_text("CPN_CONNECT"))
    """Endpoints to connect to, separated by commas, for example tcp/127.0.0.1:7447 or tls/router:7447. CPN_CONNECT."""
    namespace: str = field(default_factory=_text("CPN_NAMESPACE"))
    """Prefix of every key, which separates runs that share a network. CPN_NAMESPACE."""
    zenoh_config: Path | None = field(default_factory=_file("ZENOH_CONFIG"))
    """Zenoh configuration file (.json5, .json or .yaml), over which other options win. ZENOH_CONFIG."""
    user: str = field(default_factory=_text("CPN_USER"))
    """User name for routers that ask for one. CPN_USER."""
    password_file: Path | None = field(default_factory=_file("CPN_PASSWORD_FILE"))
    """File with the user's password. CPN_PASSWORD_FILE."""
    tls_ca: Path | None = field(default_factory=_file("CPN_TLS_CA"))
    """Certificate of the network's authority, in PEM. CPN_TLS_CA."""
    tls_certificate: Path | None = field(default_factory=_file("CPN_TLS_CERTIFICATE"))
    """Certificate of this process, in PEM, of the role viewer. CPN_TLS_CERTIFICATE."""
    tls_private_key: Path | None = field(default_factory=_file("CPN_TLS_PRIVATE_KEY"))
    """Private key of the certificate, in PEM. CPN_TLS_PRIVATE_KEY."""

    @property
    def endpoints(self) -> list[str]:
        """Endpoints to connect to."""
        return [endpoint.strip() for endpoint in self.connect.split(",") if endpoint.strip()]


def open_session(options: ZenohConfig) -> zenoh.Session:
    """Session that connects to its endpoints: a peer goes on trying in the background, a client needs its router now.

    Raises:
        ViewError: If an option is malformed, a file cannot be used, or a client reaches no router.
    """
    if options.mode not in ("", "peer", "client"):
        raise ViewError(f"--mode (CPN_MODE): expected peer or client, got {options.mode!r}")
    if not options.endpoints and options.zenoh_config is None:
        raise ViewError("--connect (CPN_CONNECT): expected an endpoint of the network, got none")
    _require_files(options, "zenoh_config", "password_file", "tls_ca", "tls_certificate", "tls_private_key")
    settings = _settings(options)
    try:
        config = zenoh.Config.from_file(options.zenoh_config) if options.zenoh_config else zenoh.Config()
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = re.sub(r"\s+at /\S+:\d+\.?", "", str(error))
        raise ViewError(
            f"zenoh: expected a network at {options.connect or options.zenoh_config}, got {reason}"
        ) from None


def _require_files(options: ZenohConfig, *names: str) -> None:
    for name in names:
        path: Path | None = getattr(options, name)
        try:
            if path:
                path.read_text()
        except (OSError, UnicodeDecodeError) as error:
            raise ViewError(f"--{name.replace('_', '-')}: expected a file that can be read, got {error}") from None


def _settings(options: ZenohConfig) -> dict[str, object]:
    settings: dict[str, object] = {"listen/endpoints": []}
    if options.zenoh_config is None:
        settings |= {"mode": "peer", "scouting/multicast/enabled": False, "connect/retry": RETRY}
        settings |= {"transport/link/rx/max_message_size": MAX_MESSAGE_BYTES}
    if options.mode:
        settings["mode"] = options.mode
    if options.endpoints:
        settings["connect/endpoints"] = options.endpoints
    if options.namespace:
        settings["namespace"] = options.namespace
    return settings | _user(options) | _tls(options)


def _user(options: ZenohConfig) -> dict[str, object]:
    if bool(options.user) != (options.password_file is not None):
        raise ViewError("--user, --password-file (CPN_USER, CPN_PASSWORD_FILE): expected both or none, got one")
    if options.password_file is None:
        return {}
    password = options.password_file.read_text().rstrip("\r\n")
    return {"transport/auth/usrpwd/user": options.user, "transport/auth/usrpwd/password": password}


def _tls(options: ZenohConfig) -> dict[str, object]:
    files = (options.tls_ca, options.tls_certificate, options.tls_private_key)
    if not any(files):
        return {}
    ca, certificate, private_key = (str(file) if file else "" for file in files)
    if not all(files):
        raise ViewError("--tls-ca, --tls-certificate, --tls-private-key: expected all or none, got some")
    try:
        # Zenoh reports a faulty file only as a router that does not answer.
        # An empty password, since OpenSSL would prompt on the terminal.
        ssl.create_default_context(cafile=ca).load_cert_chain(certificate, private_key, password="")
    except ssl.SSLError as error:
        expected = "an authority, a certificate and its key"
        raise ViewError(f"--tls-ca, --tls-certificate, --tls-private-key: expected {expected}, got {error}") from None
    # A single thread, since zenoh's TLS links read and write one stream from two threads at once, which corrupts memory
    # sooner or later (eclipse-zenoh/zenoh#2557). Zenoh reads this when its first session is opened.
    os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1), tx: (handover: rx))")
    settings = {
        "root_ca_certificate": ca,
        "connect_certificate": certificate,
        "connect_private_key": private_key,
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    return {f"transport/link/tls/{key}": value for key, value in settings.items()}
