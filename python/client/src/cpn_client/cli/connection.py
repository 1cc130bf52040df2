"""Options of the connection to a planner."""

from collections.abc import Callable
from dataclasses import dataclass, field

import cpn_client
from cpn_client.cli.arguments import Address, File, Text
from cpn_client.environment import ADDRESS, read_token, tls_of, variable


def _environment(name: str, otherwise: str = "") -> Callable[[], str]:
    """Default factory that reads an environment variable."""
    return lambda: variable(name, otherwise)


@dataclass(frozen=True)
class Connection:
    """Connection to the planner. Environment variables stand in for options that are not given."""

    planner: Address = field(default_factory=_environment("CPN_CONNECT", ADDRESS))
    """Address: tcp/HOST:PORT or tls/HOST:PORT for zenoh, grpc://HOST:PORT or grpcs://HOST:PORT. CPN_CONNECT."""
    planner_name: Text = field(default_factory=_environment("CPN_PLANNER_NAME", "planner"))
    """Name of the planner in its zenoh keys. CPN_PLANNER_NAME."""
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
            self.planner,
            name=self.planner_name,
            namespace=self.namespace,
            tls=tls_of(self.tls_ca, self.tls_certificate, self.tls_private_key, field="--tls-ca"),
            token=read_token(self.token_file, field="--token-file"),
        )
