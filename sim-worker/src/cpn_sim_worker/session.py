"""Opens zenoh sessions, and asks services over them."""

import json
from dataclasses import dataclass
from typing import Literal, TypeVar

import zenoh
from google.protobuf.message import Message

from cpn.v1 import types_pb2
from cpn_sim_worker.wire import RequestError, decode, encoding

M = TypeVar("M", bound=Message)


@dataclass(frozen=True)
class ZenohConfig:
    """How to join the network."""

    mode: Literal["peer", "client"] = "peer"
    """A peer talks to other peers directly; a client goes through a router."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, for example tcp/127.0.0.1:7447. Peers that share one find each other by gossip."""
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)
    """Endpoints where a peer accepts other peers. Port 0 picks a free one."""
    namespace: str | None = None
    """Prefix of every key, which keeps apart runs that share a network."""


def open_session(config: ZenohConfig) -> zenoh.Session:
    """A session that keeps trying to reach its endpoints, so that services may start in any order."""
    settings: dict[str, object] = {
        "mode": config.mode,
        # Multicast fails without a word in containers: endpoints are explicit.
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": True}},
        "connect": {"endpoints": config.connect, "timeout_ms": -1, "exit_on_failure": False},
    }
    if config.mode == "peer":
        settings["listen"] = {"endpoints": config.listen}
    if config.namespace is not None:
        settings["namespace"] = config.namespace
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


class UnavailableError(Exception):
    """Nobody answered. Asking again later may help."""


def ask(session: zenoh.Session, key: str, request: Message, response_type: type[M], timeout_seconds: float) -> M:
    """Queries the one service behind `key`.

    Raises:
        UnavailableError: If no reply came in time.
        RequestError: If the service refused the request.
    """
    replies = session.get(
        key, payload=request.SerializeToString(), encoding=encoding(type(request)), timeout=timeout_seconds
    )
    for reply in replies:
        if reply.ok is not None:
            return decode(response_type, reply.ok.payload.to_bytes())
        # zenoh reports its own timeouts as error replies too, in another encoding.
        if reply.err is not None and str(reply.err.encoding) == encoding(types_pb2.Error):
            raise RequestError.from_proto(decode(types_pb2.Error, reply.err.payload.to_bytes()))
    raise UnavailableError(f"no reply on {key} within {timeout_seconds} s")
