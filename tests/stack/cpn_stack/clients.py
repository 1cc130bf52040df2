"""Clients of the stack that run on the host."""

import json
from pathlib import Path
from typing import Any

import grpc
import zenoh

from cpn_stack.messages import decode, message

PLANNER = "/cpn.v1.PlannerService/"


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


def channel(port: int, certificates: Path) -> grpc.Channel:
    """gRPC with a client certificate."""
    ca, key, certificate = (
        (certificates / name).read_bytes() for name in ("ca.pem", "private-key.pem", "certificate.pem")
    )
    return grpc.secure_channel(f"localhost:{port}", grpc.ssl_channel_credentials(ca, key, certificate))


def call_planner(open_channel: grpc.Channel, method: str, **fields: object) -> Any:
    """What a planner answers.

    Raises:
        grpc.RpcError: If it refuses.
    """
    call = open_channel.unary_unary(
        PLANNER + method, response_deserializer=lambda payload: decode(f"{method}Response", payload)
    )
    return call(message(f"{method}Request", **fields).SerializeToString(), timeout=60)
