"""Interface of the transports, and their addresses."""

import re
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from cpn_client.deadline import Deadline
from cpn_client.errors import invalid
from cpn_client.requests import Request


@dataclass(frozen=True)
class Tls:
    """Files of TLS, in PEM.

    Raises:
        ValueError: If only one of certificate and private key is given.
    """

    ca: Path | str
    """Certificate of the network's authority."""
    certificate: Path | str | None = None
    """Certificate of this client."""
    private_key: Path | str | None = None

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.private_key is None):
            missing, given = ("certificate", "private_key") if self.private_key else ("private_key", "certificate")
            raise invalid(missing, f"a file, as {given} is given", None)

    def check(self) -> None:
        """Reads the files, since zenoh would report a faulty one only as a router that does not answer.

        Raises:
            ValueError: If they are not an authority, a certificate and its key.
        """
        try:
            context = ssl.create_default_context(cafile=self.ca)
            if self.certificate:
                # An empty password, since OpenSSL would prompt on the terminal.
                context.load_cert_chain(self.certificate, self.private_key, password="")
        except OSError as error:
            expected = f"an authority {self.ca}, and a certificate {self.certificate} with its key {self.private_key}"
            raise invalid("tls", expected, error) from None


@dataclass(frozen=True)
class Address:
    """Address of a planner, with the means to be let in."""

    endpoint: str
    name: str
    namespace: str
    tls: Tls | None
    token: str

    @property
    def is_grpc(self) -> bool:
        """Whether the planner is asked over gRPC, not zenoh."""
        return self.endpoint.startswith(("grpc://", "grpcs://"))

    def check(self) -> None:
        """Checks the combination of settings.

        Raises:
            ValueError: If the endpoint is malformed, a setting does not go with it, or a file of TLS is faulty.
        """
        if not self.is_grpc and not re.fullmatch(r"[a-z_-]+/.+", self.endpoint):
            expected = "a zenoh endpoint, for example tcp/127.0.0.1:7447, or grpc://HOST:PORT or grpcs://HOST:PORT"
            raise invalid("address", expected, repr(self.endpoint))
        if not re.fullmatch(r"[^/*$?#]+", self.name):
            raise invalid("name", "the name of a planner", repr(self.name))
        if self.is_grpc and (self.namespace or self.name != "planner"):
            raise invalid("address", "a zenoh endpoint, as name or namespace is given", self.endpoint)
        if self.token and not self.endpoint.startswith("grpcs://"):
            raise invalid("address", "grpcs://HOST:PORT, as a token is given", self.endpoint)
        if self.tls and self.endpoint.startswith("grpc://"):
            raise invalid("address", "grpcs://HOST:PORT, as TLS files are given", self.endpoint)
        if self.tls:
            self.tls.check()


class Transport(Protocol):
    """Connection to a planner. Each call has a channel of its own, so that no late reply is taken for another's."""

    def call(self, request: Request, deadline: Deadline) -> bytes:
        """Sends a request once, and returns the bytes of its reply.

        Raises:
            PlannerError: If no reply came in time, or the planner refused.
        """
        ...

    def close(self) -> None:
        """Ends the connection."""
        ...


class AsyncTransport(Protocol):
    """Transport for asyncio."""

    async def call(self, request: Request, deadline: Deadline) -> bytes:
        """Sends a request once, and returns the bytes of its reply.

        Raises:
            PlannerError: If no reply came in time, or the planner refused.
        """
        ...

    async def close(self) -> None:
        """Ends the connection."""
        ...
