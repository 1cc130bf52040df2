"""Conversions between NumPy arrays and the messages of `cpn.v1`, and the error of an invalid message."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from google.protobuf.message import DecodeError, Message

from cpn.v1 import types_pb2

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_PAYLOAD_BYTES = 1 << 20
"""Largest message, far above all of the project except checkpoints, which no worker receives."""
MAX_TEXT_BYTES = 500
"""Longest `expected` and `got` of an error, which may quote untrusted text."""

M = TypeVar("M", bound=Message)


class RequestError(Exception):
    """Refusal of a request, encoded as `cpn.v1.Error`."""

    def __init__(self, code: types_pb2.ErrorCode, field: str, expected: object, got: object) -> None:
        name = types_pb2.ErrorCode.Name(code).removeprefix("ERROR_CODE_")
        super().__init__(f"{name} {field}: expected {expected}, got {got}")
        self.code = code
        self.field = field
        self.expected = _cut(str(expected))
        self.got = _cut(str(got))

    def to_proto(self) -> types_pb2.Error:
        """Encodes the error."""
        return types_pb2.Error(code=self.code, field=self.field, expected=self.expected, got=self.got)

    @classmethod
    def from_proto(cls, error: types_pb2.Error) -> RequestError:
        """Decodes a service's error."""
        return cls(error.code, error.field, error.expected, error.got)


def _cut(text: str) -> str:
    data = text.encode(errors="replace")
    return text if len(data) <= MAX_TEXT_BYTES else data[:MAX_TEXT_BYTES].decode(errors="ignore") + "…"


def invalid(field: str, expected: object, got: object) -> RequestError:
    """`INVALID_ARGUMENT` about a field."""
    return RequestError(types_pb2.ERROR_CODE_INVALID_ARGUMENT, field, expected, got)


def encoding(message_type: type[Message]) -> str:
    """Zenoh encoding of a message type."""
    return f"application/protobuf;{message_type.DESCRIPTOR.full_name}"


def decode(message_type: type[M], payload: bytes) -> M:
    """Decodes a message.

    Raises:
        RequestError: If the payload is larger than 1 MiB, or not such a message.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise invalid("payload", f"at most {MAX_PAYLOAD_BYTES} bytes", len(payload))
    message = message_type()
    try:
        message.ParseFromString(payload)
    except DecodeError:
        raise invalid("payload", message_type.DESCRIPTOR.full_name, f"{len(payload)} other bytes") from None
    return message


def image_to_proto(pixels: NDArray[np.uint8], render_spec: str) -> types_pb2.Image:
    """Encodes an image, [84, 84, 3], with its render spec."""
    height, width, _ = pixels.shape
    return types_pb2.Image(
        height=height,
        width=width,
        format=types_pb2.PIXEL_FORMAT_RGB8,
        data=pixels.tobytes(),
        render_spec=render_spec,
    )


def action_to_proto(action: NDArray[np.float32]) -> types_pb2.Action:
    """Encodes an action, [A]."""
    return types_pb2.Action(values=action.tolist())


def action_from_proto(action: types_pb2.Action, size: int, field: str) -> NDArray[np.float32]:
    """Decodes and validates an action, [size] in [-1, 1]; `field` names it in a `RequestError`."""
    import numpy as np  # Imported late: it would double the time of a health check, which needs no arrays.

    if len(action.values) != size:
        raise invalid(f"{field}.values", f"{size} values", len(action.values))
    values = np.array(action.values, np.float32)
    # In this form NaN, which compares false with everything, is refused too.
    if not np.all(np.abs(values) <= 1):
        raise invalid(f"{field}.values", "finite values in [-1, 1]", values.tolist())
    return values
