"""Metrics of a planner, read by the host."""

import http.client
import ssl
from pathlib import Path

from prometheus_client.parser import text_string_to_metric_families


class Metrics:
    """Reads metrics over TLS with a client certificate."""

    def __init__(self, port: int, certificates: Path) -> None:
        self._port = port
        self._context = ssl.create_default_context(cafile=str(certificates / "ca.pem"))
        self._context.load_cert_chain(certificates / "certificate.pem", certificates / "private-key.pem")
        self._connection: http.client.HTTPSConnection | None = None

    def total(self, counter: str) -> float | None:
        """A counter's sum over all labels; None while nobody answers."""
        try:
            if self._connection is None:
                self._connection = http.client.HTTPSConnection(
                    "127.0.0.1", self._port, context=self._context, timeout=2
                )
            self._connection.request("GET", "/metrics")
            text = self._connection.getresponse().read().decode()
        except (OSError, http.client.HTTPException):
            self._connection = None
            return None
        families = text_string_to_metric_families(text)
        return sum(sample.value for family in families for sample in family.samples if sample.name == counter)
