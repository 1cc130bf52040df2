"""Connection by environment variables, the same as those of the command line."""

import os
from pathlib import Path

from cpn_client.connection import connect
from cpn_client.errors import invalid
from cpn_client.planner import Planner
from cpn_client.transport import Tls

ADDRESS = "tcp/127.0.0.1:7447"
"""Address of a planner on this machine, or of its router."""


def connect_from_environment(address: str = "") -> Planner:
    """Connects as environment variables say; see `connect`, whose errors it raises.

    They are `CPN_CONNECT`, `CPN_PLANNER_NAME`, `CPN_NAMESPACE`, `CPN_TLS_CA`, `CPN_TLS_CERTIFICATE`,
    `CPN_TLS_PRIVATE_KEY` and `CPN_TOKEN_FILE`; an empty one counts as unset.

    Args:
        address: Address in place of that in `CPN_CONNECT`.

    Raises:
        ValueError: If a variable does not go with another or with the address, or a file cannot be read.
    """
    tls = [variable(f"CPN_TLS_{name}") for name in ("CA", "CERTIFICATE", "PRIVATE_KEY")]
    return connect(
        address or variable("CPN_CONNECT", ADDRESS),
        name=variable("CPN_PLANNER_NAME", "planner"),
        namespace=variable("CPN_NAMESPACE"),
        tls=tls_of(*tls, field="CPN_TLS_CA"),
        token=read_token(variable("CPN_TOKEN_FILE"), field="CPN_TOKEN_FILE"),
    )


def variable(name: str, otherwise: str = "") -> str:
    """Value of an environment variable; `otherwise` if it is unset or empty."""
    return os.environ.get(name) or otherwise


def tls_of(ca: str, certificate: str, private_key: str, *, field: str) -> Tls | None:
    """Files of TLS, none of which is required; `field` names that of the authority in errors.

    Raises:
        ValueError: If there is a certificate or key without an authority.
    """
    if ca:
        return Tls(ca, certificate or None, private_key or None)
    if certificate or private_key:
        raise invalid(field, f"a file, as {certificate or private_key} is given", "none")
    return None


def read_token(file: str, *, field: str) -> str:
    """Token in a file; empty without a file.

    Raises:
        ValueError: If the file cannot be read.
    """
    try:
        return Path(file).read_text().strip() if file else ""
    except (OSError, UnicodeDecodeError) as error:
        raise invalid(field, "a file with a token", error) from None
