"""Connections to planners."""

from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager

from tenacity import AsyncRetrying, Retrying

from cpn_client.deadline import Deadline, retries
from cpn_client.planner import AsyncPlanner, Planner
from cpn_client.transport import Address, AsyncTransport, Tls, Transport

TIMEOUT_SECONDS = 10.0


def connect(
    address: str,
    *,
    name: str = "planner",
    namespace: str = "",
    tls: Tls | None = None,
    token: str = "",
    timeout_seconds: float = TIMEOUT_SECONDS,
) -> Planner:
    """Connects to a planner; to be closed, or used as a context manager.

    Args:
        address: Zenoh endpoint of a router or of the planner itself, for example `tcp/127.0.0.1:7447` or
            `tls/router:7447`; or `grpc://HOST:PORT`, which is plain text, or `grpcs://HOST:PORT`, which is TLS.
        name: Name of the planner in its zenoh keys.
        namespace: Prefix of every zenoh key, as the planner's own.
        tls: Files of TLS; gRPC without them trusts the system's authorities.
        token: Token in place of a client's certificate, for `grpcs://`.
        timeout_seconds: Longest wait for the connection, and for the answer to a request without a deadline.

    Raises:
        ValueError: If the address is malformed, a setting does not go with it, or a file of TLS is faulty.
        ImportError: If the address is of gRPC, and the extra `grpc` is not installed.
        UnreachableError: If there is no connection in time.
        NoPlannerError: If the connection leads to no planner.
        RefusedError: If the planner refuses this client.
    """
    where = Address(address, name, namespace, tls, token)
    where.check()
    planner = Planner(_open(where, Deadline(timeout_seconds)), timeout_seconds)
    try:
        planner.models()
    except BaseException:
        planner.close()
        raise
    return planner


@asynccontextmanager
async def connect_async(
    address: str,
    *,
    name: str = "planner",
    namespace: str = "",
    tls: Tls | None = None,
    token: str = "",
    timeout_seconds: float = TIMEOUT_SECONDS,
) -> AsyncGenerator[AsyncPlanner, None]:
    """Context manager of a connection to a planner for asyncio; see `connect`."""
    where = Address(address, name, namespace, tls, token)
    where.check()
    transport = await _open_async(where, Deadline(timeout_seconds))
    try:
        planner = AsyncPlanner(transport, timeout_seconds)
        await planner.models()
        yield planner
    finally:
        await transport.close()


# The libraries are imported when they are needed: gRPC may not be installed, and each takes a while.


def _open(address: Address, deadline: Deadline) -> Transport:
    if address.is_grpc:
        from cpn_client.grpc import GrpcTransport

        return GrpcTransport(address)
    from cpn_client.zenoh import ZenohTransport, open_session

    return ZenohTransport(Retrying(**retries(deadline))(open_session, address), address)


async def _open_async(address: Address, deadline: Deadline) -> AsyncTransport:
    if address.is_grpc:
        from cpn_client.grpc import AsyncGrpcTransport

        return AsyncGrpcTransport(address)
    from cpn_client.zenoh import AsyncZenohTransport, open_session_async

    return AsyncZenohTransport(await AsyncRetrying(**retries(deadline))(open_session_async, address), address)
