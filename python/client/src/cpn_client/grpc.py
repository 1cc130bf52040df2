"""Transport over gRPC: each request is a call of its own."""

from pathlib import Path
from typing import Any

from cpn_client.deadline import Deadline
from cpn_client.errors import NoPlannerError, PlannerError, RefusedError, UnreachableError
from cpn_client.requests import MAX_MESSAGE_BYTES, Request, refusal
from cpn_client.transport import Address, Tls

try:
    import grpc
    import grpc.aio
except ModuleNotFoundError:
    raise ImportError("address: grpc:// and grpcs:// need grpcio: pip install 'cpn-client[grpc]'") from None

SERVICE = "/cpn.v1.PlannerService/"
OPTIONS = [
    ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
    # Times between attempts to connect, which are minutes by default.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 500),
    # Else a second channel to the address shares the first one's connection, and its wait after a failure.
    ("grpc.use_local_subchannel_pool", 1),
]


class _Calls:
    """Calls to the planner of an address, and their errors."""

    def __init__(self, address: Address, library: Any) -> None:  # noqa: ANN401
        self._address = address
        scheme, target = address.endpoint.split("://", 1)
        if scheme == "grpcs":
            self._channel = library.secure_channel(target, _credentials(address.tls), OPTIONS)
        else:
            self._channel = library.insecure_channel(target, OPTIONS)
        self._metadata = [("authorization", f"Bearer {address.token}")] if address.token else None

    def _send(self, request: Request, deadline: Deadline) -> Any:  # noqa: ANN401
        call = self._channel.unary_unary(SERVICE + request.method)
        return call(request.encode(deadline), timeout=deadline.left(), metadata=self._metadata)

    def _error(self, error: Any, deadline: Deadline) -> PlannerError:  # noqa: ANN401
        code, details = error.code(), error.details()
        for key, value in error.trailing_metadata() or ():
            if key == "grpc-status-details-bin":
                return refusal(value)
        if code == grpc.StatusCode.DEADLINE_EXCEEDED:
            return deadline.late()
        if code == grpc.StatusCode.UNAVAILABLE:
            return UnreachableError(f"{self._address.endpoint}: {details}")
        if code == grpc.StatusCode.UNIMPLEMENTED:
            return NoPlannerError(f"{self._address.endpoint}: expected a planner, got another server")
        return RefusedError(code.name, "", "an answer", details)


class GrpcTransport(_Calls):
    """Transport over gRPC."""

    def __init__(self, address: Address) -> None:
        super().__init__(address, grpc)

    def call(self, request: Request, deadline: Deadline) -> bytes:
        """Sends a request; see `Transport`."""
        try:
            return self._send(request, deadline)
        except grpc.RpcError as error:
            raise self._error(error, deadline) from None

    def close(self) -> None:
        """Closes the channel."""
        self._channel.close()


class AsyncGrpcTransport(_Calls):
    """Transport over gRPC for asyncio."""

    def __init__(self, address: Address) -> None:
        super().__init__(address, grpc.aio)

    async def call(self, request: Request, deadline: Deadline) -> bytes:
        """Sends a request; see `AsyncTransport`."""
        try:
            return await self._send(request, deadline)
        except grpc.aio.AioRpcError as error:
            raise self._error(error, deadline) from None

    async def close(self) -> None:
        """Closes the channel."""
        await self._channel.close()


def _credentials(tls: Tls | None) -> grpc.ChannelCredentials:
    if tls is None:
        return grpc.ssl_channel_credentials()
    files = (tls.ca, tls.private_key, tls.certificate)
    return grpc.ssl_channel_credentials(*(Path(file).read_bytes() if file else None for file in files))
