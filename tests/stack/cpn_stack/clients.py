"""Clients of the stack that run on the host."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import grpc
import zenoh

from cpn.v1 import planner_pb2_grpc


def open_zenoh(endpoint: str, certificates: Path | None, ca: Path | None = None) -> zenoh.Session:
    """A zenoh client of a router.

    Raises:
        zenoh.ZError: If the router does not take it within a few seconds.
    """
    config = zenoh.Config()
    settings: dict[str, object] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 5000,
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
    }
    if certificates is not None:
        settings |= {
            "transport/link/tls/root_ca_certificate": str((ca or certificates) / "ca.pem"),
            "transport/link/tls/connect_certificate": str(certificates / "certificate.pem"),
            "transport/link/tls/connect_private_key": str(certificates / "private-key.pem"),
            "transport/link/tls/enable_mtls": True,
        }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


@contextmanager
def open_grpc(port: int, certificates: Path) -> Iterator[planner_pb2_grpc.PlannerServiceStub]:
    """A planner's gRPC service, called with a client certificate."""
    ca, key, certificate = (
        (certificates / name).read_bytes() for name in ("ca.pem", "private-key.pem", "certificate.pem")
    )
    credentials = grpc.ssl_channel_credentials(ca, key, certificate)
    with grpc.secure_channel(f"localhost:{port}", credentials) as channel:
        yield planner_pb2_grpc.PlannerServiceStub(channel)
