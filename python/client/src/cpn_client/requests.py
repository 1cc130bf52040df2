"""Requests to a planner and their replies, without a transport.

An exchange is a generator that yields requests, receives the bytes of each reply or the error in its place, and returns
the result. `Planner` and `AsyncPlanner` run the same exchanges.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

from google.protobuf.message import DecodeError, Message

from cpn.v1 import planner_pb2, types_pb2
from cpn_client.deadline import Deadline
from cpn_client.errors import LateError, PlannerError, RefusedError
from cpn_client.image import Image, ImageLike, Position, image_or_position
from cpn_client.plan import Action, Approach, Goal, Model, Plan, Search, StageTimes

T = TypeVar("T")
M = TypeVar("M", bound=Message)

MAX_MESSAGE_BYTES = 16 << 20
"""Largest reply, a list of models."""


@dataclass(frozen=True)
class Request:
    """Request of a method of `cpn.v1.PlannerService`."""

    method: str
    message: Message

    def encode(self, deadline: Deadline) -> bytes:
        """Encodes the request, with the time left for it as a plan's own deadline.

        Raises:
            PlannerError: If the deadline has passed.
        """
        left = deadline.left()
        if isinstance(self.message, planner_pb2.PlanRequest) and self.message.deadline_ms:
            self.message.deadline_ms = max(1, round(1000 * left))
        return self.message.SerializeToString()


Exchange: TypeAlias = Generator[Request, bytes, T]


def plan_request(
    *,
    model: str,
    goal: Goal | ImageLike | Position,
    observation: ImageLike | Position,
    seed: int,
    deadline_ms: int | None,
    search: Search | None,
    warm_start: Sequence[Action],
    approach: Approach | None,
    steps_left: int | None,
    model_digest: str,
) -> planner_pb2.PlanRequest:
    """Request of a plan.

    Raises:
        ValueError: If goal or observation is neither image nor position, or a number is out of its range.
    """
    request = planner_pb2.PlanRequest(
        model=model,
        seed=seed,
        deadline_ms=deadline_ms or 0,
        model_digest=model_digest,
        search=search.to_proto() if search else None,
        warm_start=[types_pb2.Action(values=action) for action in warm_start],
        approach=approach.to_proto() if approach else None,
        steps_left=steps_left,
    )
    if isinstance(goal, Goal):
        request.goal_id = goal.id
    else:
        target = image_or_position(goal, "goal")
        if isinstance(target, Image):
            request.goal_image.CopyFrom(target.to_proto())
        else:
            request.goal_position.CopyFrom(target)
    observed = image_or_position(observation, "observation")
    if isinstance(observed, Image):
        request.observation.CopyFrom(observed.to_proto())
    else:
        request.position.CopyFrom(observed)
    return request


def plan(request: planner_pb2.PlanRequest, goal: object) -> Exchange[Plan]:
    """Plan, for which a goal that the planner does not know is registered again."""
    try:
        reply = yield Request("Plan", request)
    except RefusedError as error:
        if not isinstance(goal, Goal) or (error.code, error.field) != ("NOT_FOUND", "goal_id"):
            raise
        yield from register(goal.image)
        reply = yield Request("Plan", request)
    return _plan(_decode(planner_pb2.PlanResponse, reply), request.ByteSize())


def register(image: Image) -> Exchange[Goal]:
    """Registration of a goal image."""
    reply = yield Request("RegisterGoal", planner_pb2.RegisterGoalRequest(image=image.to_proto()))
    return Goal(_decode(planner_pb2.RegisterGoalResponse, reply).goal_id, image)


def models() -> Exchange[tuple[Model, ...]]:
    """Served models."""
    reply = yield Request("ListModels", planner_pb2.ListModelsRequest())
    served = _decode(planner_pb2.ListModelsResponse, reply).models
    return tuple(
        Model(info.name, info.method, info.digest, tuple(info.training_tasks), info.horizon, info.version)
        for info in served
    )


def refusal(payload: bytes) -> PlannerError:
    """Error of a planner, from a `cpn.v1.Error`."""
    error = _decode(types_pb2.Error, payload)
    if error.code == types_pb2.ERROR_CODE_DEADLINE_EXCEEDED:
        return LateError(f"{error.field}: expected {error.expected}, got {error.got}")
    code = types_pb2.ErrorCode.Name(error.code).removeprefix("ERROR_CODE_")
    return RefusedError(code, error.field, error.expected, error.got)


def _plan(response: planner_pb2.PlanResponse, request_bytes: int) -> Plan:
    times = response.times
    return Plan(
        actions=_actions(response.actions),
        first_action=tuple(response.first_action.values),
        inner_losses=tuple(response.inner_losses),
        latent_distance=response.latent_distance if response.HasField("latent_distance") else None,
        times=StageTimes(times.queue_seconds, times.encode_seconds, times.plan_seconds),
        model_digest=response.model_digest,
        goal_id=response.goal_id,
        iterations=response.iterations,
        iterations_run=response.iterations_run,
        warm_start=_actions(response.warm_start),
        approach=_approach(response),
        request_bytes=request_bytes,
    )


def _actions(actions: Sequence[types_pb2.Action]) -> tuple[Action, ...]:
    return tuple(tuple(action.values) for action in actions)


def _approach(response: planner_pb2.PlanResponse) -> Approach | None:
    if not response.HasField("approach"):
        return None
    approach = response.approach
    return Approach(approach.tried, tuple(approach.position), approach.plans)


def _decode(message_type: type[M], payload: bytes) -> M:
    message = message_type()
    try:
        message.ParseFromString(payload)
    except DecodeError:
        raise PlannerError(f"reply: expected {message_type.DESCRIPTOR.full_name}, got other bytes") from None
    return message
