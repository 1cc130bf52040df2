import numpy as np
import pytest

from cpn.v1 import sim_pb2, types_pb2
from cpn_sim_worker.spaces import IMAGE_SIZE
from cpn_sim_worker.wire import (
    MAX_PAYLOAD_BYTES,
    RequestError,
    action_from_proto,
    action_to_proto,
    decode,
    image_to_proto,
)
from tests.support import pixels

GENERATOR = np.random.default_rng(0)


def test_image_to_message() -> None:
    frame = GENERATOR.integers(0, 256, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
    image = image_to_proto(frame, "how")
    assert np.array_equal(pixels(image), frame)
    assert image.render_spec == "how"


def test_action_round_trip() -> None:
    action = GENERATOR.uniform(-1, 1, 4).astype(np.float32)
    assert np.array_equal(action_from_proto(action_to_proto(action), 4, "action"), action)


@pytest.mark.parametrize(
    "values", [[], [0.0] * 3, [0.0] * 5, [float("nan"), 0, 0, 0], [0, float("inf"), 0, 0], [0, 0, 0, 1.001]]
)
def test_invalid_action_is_named(values: list[float]) -> None:
    with pytest.raises(RequestError) as caught:
        action_from_proto(types_pb2.Action(values=values), 4, "action")
    assert caught.value.field == "action.values"
    assert caught.value.code == types_pb2.ERROR_CODE_INVALID_ARGUMENT


@pytest.mark.parametrize("payload", [b"\x0a\x7f", b"\xff" * 20, b"\0" * (MAX_PAYLOAD_BYTES + 1)])
def test_undecodable_payload_is_refused(payload: bytes) -> None:
    """A length past the end, an endless varint, and an oversized payload."""
    with pytest.raises(RequestError) as caught:
        decode(sim_pb2.ResetRequest, payload)
    assert caught.value.field == "payload"


def test_error_round_trip() -> None:
    error = RequestError(types_pb2.ERROR_CODE_NOT_FOUND, "episode_id", "a", "b")
    assert str(RequestError.from_proto(error.to_proto())) == str(error) == "NOT_FOUND episode_id: expected a, got b"
