"""Plans of positions, as the planner answers them."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import zenoh
from google.protobuf.message import Message
from numpy.typing import NDArray

from cpn.v1 import demonstration_pb2, planner_pb2, types_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.jenga import ACTION_METRES
from cpn_sim_worker.session import UnavailableError, ZenohConfig, ask, open_session
from cpn_sim_worker.wire import decode

START_SECONDS = 60.0
"""How long services may take to start."""
REQUEST_SECONDS = 10.0
TRIES = 3
"""How often a request is sent that nobody answers."""

M = TypeVar("M", bound=Message)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Demonstration:
    """One recorded trajectory."""

    positions: Array
    """[T + 1, 3], the fingertip, in metres."""
    actions: Array
    """[T, 3], in [-1, 1]."""
    goal: Array
    """[3], in metres."""


@contextmanager
def network(endpoint: str, *services: str) -> Iterator[zenoh.Session]:
    """A session in the namespace of this run, once the services of these liveliness keys are there."""
    with open_session(ZenohConfig(connect=(endpoint,))) as session:
        deadline = time.monotonic() + START_SECONDS
        for key in services:
            while not any(reply.ok is not None for reply in session.liveliness().get(key, timeout=1.0)):
                if time.monotonic() > deadline:
                    raise SystemExit(f"{key}: nobody is there after {START_SECONDS} s")
                time.sleep(0.1)
        yield session


def request(session: zenoh.Session, key: str, message: Message, response_type: type[M]) -> M:
    """The answer of the one service behind `key`. Whatever is asked here may be asked again; a step is applied once.

    Raises:
        UnavailableError: If no try was answered in time.
        RequestError: If the service refused the request.
    """
    for number in range(1, TRIES):
        try:
            return ask(session, key, message, response_type, REQUEST_SECONDS)
        except UnavailableError as error:
            print(f"{error}: try {number} of {TRIES}", file=sys.stderr)
    return ask(session, key, message, response_type, REQUEST_SECONDS)


def demonstrations(session: zenoh.Session, episodes: list[str]) -> list[Demonstration]:
    """What the recorder of the session holds of these episodes."""
    found: list[Demonstration] = []
    for episode in episodes:
        replies = session.get(keys.demonstration_step(episode, "*"), timeout=REQUEST_SECONDS)
        samples = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
        steps = sorted((decode(demonstration_pb2.DemonstrationStep, s) for s in samples), key=lambda step: step.step)
        if not steps:
            raise SystemExit(f"{episode}: the recorder has no such episode")
        states = np.array([step.state for step in steps], np.float64)
        actions = np.array([step.action.values for step in steps if step.HasField("action")], np.float64)
        found.append(Demonstration(states[:, :3], actions, states[0, 13:16]))
    return found


class Planner:
    """Asks a planner for plans between positions."""

    def __init__(self, session: zenoh.Session, name: str) -> None:
        self._session = session
        self._name = name

    def plan(self, model: str, hand: Array, goal: Array, updates: int | None = None) -> Array:
        """The next actions of the hand towards the goal, [H, 3], clipped to [-1, 1].

        Without a number of updates it is the model's own.
        """
        gradient = planner_pb2.SOLVER_GRADIENT
        search = None if updates is None else planner_pb2.Search(solver=gradient, iterations=updates)
        message = planner_pb2.PlanRequest(model=model, position=_point(hand), goal_position=_point(goal), search=search)
        response = request(self._session, keys.planner_plan(self._name), message, planner_pb2.PlanResponse)
        return np.clip([action.values for action in response.actions], -1, 1)

    def trajectory(self, model: str, start: Array, goal: Array, length: int, updates: int | None = None) -> Array:
        """A whole trajectory planned before the hand moves, as actions, [length, 3].

        The next plan starts where the one before is predicted to end: an action of 1 moves the hand 1 cm.
        """
        actions = np.empty((0, 3))
        while len(actions) < length:
            actions = np.concatenate([actions, self.plan(model, along(start, actions)[-1], goal, updates)])
        return actions[:length]


def along(start: Array, actions: Array) -> Array:
    """The predicted positions before, between and after some actions, [T + 1, 3]."""
    return start + ACTION_METRES * np.concatenate([np.zeros((1, 3)), np.cumsum(actions, axis=0)])


def _point(position: Array) -> types_pb2.Position:
    x, y, z = position.tolist()
    return types_pb2.Position(x=x, y=y, z=z)
