"""Transport over zenoh: each request is a query of its own."""

# Zenoh's stubs leave return types out.
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false

import asyncio
import json
import os
import re
from contextlib import suppress
from typing import Any

import zenoh

from cpn.v1 import types_pb2
from cpn_client.deadline import Deadline
from cpn_client.errors import NoPlannerError, PlannerError, UnreachableError
from cpn_client.requests import MAX_MESSAGE_BYTES, Request, refusal
from cpn_client.transport import Address, Tls

KEYS = {"Plan": "plan", "RegisterGoal": "register_goal", "ListModels": "list_models"}
"""Last chunk of each method's key."""


def open_session(address: Address) -> zenoh.Session:
    """Session of a client, by one attempt to connect.

    Raises:
        UnreachableError: If no router or planner answers at the endpoint.
    """
    try:
        return zenoh.open(_config(address))
    except zenoh.ZError as error:
        reason = re.sub(r"\s+at /\S+:\d+\.?", "", str(error))
        raise UnreachableError(f"{address.endpoint}: expected a zenoh router or planner, got {reason}") from None


async def open_session_async(address: Address) -> zenoh.Session:
    """Form of `open_session` that leaves the loop free."""
    return await asyncio.to_thread(open_session, address)


def _config(address: Address) -> zenoh.Config:
    config = zenoh.Config()
    settings = {
        "mode": "client",
        "connect/endpoints": address.endpoint.split(","),
        # Of a session that has lost its connection; the first one has a single attempt.
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
    }
    if address.namespace:
        settings["namespace"] = address.namespace
    if address.tls:
        settings |= _tls(address.tls)
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _tls(tls: Tls) -> dict[str, object]:
    # A single thread, since zenoh's TLS links read and write one stream from two threads at once, which corrupts memory
    # sooner or later (eclipse-zenoh/zenoh#2557). Zenoh reads this when its first session is opened.
    os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1), tx: (handover: rx))")
    settings: dict[str, object] = {"root_ca_certificate": str(tls.ca), "close_link_on_expiration": True}
    if tls.certificate:
        own = {"connect_certificate": str(tls.certificate), "connect_private_key": str(tls.private_key)}
        settings |= own | {"enable_mtls": True}
    return {f"transport/link/tls/{key}": value for key, value in settings.items()}


class _Queries:
    """Queries to the planner of an address, and their replies."""

    def __init__(self, session: zenoh.Session, address: Address) -> None:
        self._session = session
        self._address = address

    def _send(self, request: Request, deadline: Deadline, handler: Any) -> Any:  # noqa: ANN401
        try:
            return self._session.get(
                f"cpn/@v1/planner/{self._address.name}/{KEYS[request.method]}",
                handler,
                consolidation=zenoh.ConsolidationMode.NONE,
                encoding=_encoding(request.message.DESCRIPTOR.full_name),
                payload=request.encode(deadline),
                timeout=deadline.left(),
            )
        except zenoh.ZError as error:
            raise UnreachableError(f"{self._address.endpoint}: {error}") from None

    def _read(self, reply: zenoh.Reply | None, deadline: Deadline) -> bytes:
        if reply is None:
            raise self._no_reply()
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
        # Zenoh reports its own timeouts as error replies too, in another encoding.
        if reply.err is not None and str(reply.err.encoding) == _encoding(types_pb2.Error.DESCRIPTOR.full_name):
            raise refusal(reply.err.payload.to_bytes())
        raise deadline.late()

    def _no_reply(self) -> PlannerError:
        address, info = self._address, self._session.info
        if info.routers_zid() or info.peers_zid():
            return NoPlannerError(
                f"{address.endpoint}: expected a planner named {address.name!r} that this client may ask, got none"
            )
        return UnreachableError(f"{address.endpoint}: expected a connection, got none")


class ZenohTransport(_Queries):
    """Transport over zenoh."""

    def call(self, request: Request, deadline: Deadline) -> bytes:
        """Sends a request; see `Transport`."""
        replies = self._send(request, deadline, zenoh.handlers.FifoChannel(1))
        return self._read(next(iter(replies), None), deadline)

    def close(self) -> None:
        """Ends the session."""
        self._session.close()


class AsyncZenohTransport(_Queries):
    """Transport over zenoh for asyncio."""

    async def call(self, request: Request, deadline: Deadline) -> bytes:
        """Sends a request; see `AsyncTransport`."""
        loop = asyncio.get_running_loop()
        first: asyncio.Future[zenoh.Reply | None] = loop.create_future()

        def settle(reply: zenoh.Reply | None) -> None:
            if not first.done():
                first.set_result(reply)

        def arrive(reply: zenoh.Reply | None = None) -> None:
            # The loop may have ended before a late reply, which nobody awaits.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(settle, reply)

        # Called with each reply, and without one after the last, on zenoh's own thread, which it does not hold up.
        self._send(request, deadline, zenoh.handlers.Callback(arrive, arrive, indirect=False))
        return self._read(await first, deadline)

    async def close(self) -> None:
        """Ends the session."""
        await asyncio.to_thread(self._session.close)


def _encoding(message: str) -> str:
    return f"application/protobuf;{message}"
