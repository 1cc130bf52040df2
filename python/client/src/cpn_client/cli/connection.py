"""Options of the connection to a planner."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cpn_client
from cpn_client.cli.arguments import Address, File, Text
from cpn_client.errors import invalid


def _environment(variable: str, otherwise: str = "") -> Callable[[], str]:
    """Default factory that reads an environment variable; an empty one counts as unset."""
    return lambda: os.environ.get(variable) or otherwise


@dataclass(frozen=True)
class Connection:
    """Connection to the planner. Environment variables stand in for options that are not given."""

    planner: Address = field(default_factory=_environment("CPN_CONNECT", "tcp/127.0.0.1:7447"))
    """Address: tcp/HOST:PORT or tls/HOST:PORT for zenoh, grpc://HOST:PORT or grpcs://HOST:PORT. CPN_CONNECT."""
    planner_name: Text = "planner"
    """Name of the planner in its zenoh keys."""
    namespace: Text = field(default_factory=_environment("CPN_NAMESPACE"))
    """Prefix of every zenoh key, as the planner's own. CPN_NAMESPACE."""
    tls_ca: File = field(default_factory=_environment("CPN_TLS_CA"))
    """Certificate of the network's authority, in PEM. CPN_TLS_CA."""
    tls_certificate: File = field(default_factory=_environment("CPN_TLS_CERTIFICATE"))
    """Certificate of this client, in PEM. CPN_TLS_CERTIFICATE."""
    tls_private_key: File = field(default_factory=_environment("CPN_TLS_PRIVATE_KEY"))
    """Private key of the certificate, in PEM. CPN_TLS_PRIVATE_KEY."""
    token_file: File = field(default_factory=_environment("CPN_TOKEN_FILE"))
    """File with a token in place of a certificate, for grpcs://. CPN_TOKEN_FILE."""

    def open(self) -> cpn_client.Planner:
        """Connects to the planner; see `cpn_client.connect`, whose errors it raises.

        Raises:
            ValueError: If an option does not go with another, or a file cannot be read.
        """
        return cpn_client.connect(
            self.planner, name=self.planner_name, namespace=self.namespace, tls=self._tls(), token=self._token()
        )

    def _tls(self) -> cpn_client.Tls | None:
        if self.tls_ca:
            return cpn_client.Tls(self.tls_ca, self.tls_certificate or None, self.tls_private_key or None)
        if self.tls_certificate or self.tls_private_key:
            raise invalid("--tls-ca", "a file, as --tls-certificate or --tls-private-key is given", "none")
        return None

    def _token(self) -> str:
        try:
            return Path(self.token_file).read_text().strip() if self.token_file else ""
        except (OSError, UnicodeDecodeError) as error:
            raise invalid("--token-file", "a file with a token", error) from None
