"""Planners, over either transport."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TypeVar

from tenacity import AsyncRetrying, Retrying

from cpn_client import requests
from cpn_client.deadline import Deadline, retries
from cpn_client.episode import AsyncEpisode, Episode
from cpn_client.errors import PlannerError
from cpn_client.image import Image, ImageLike, Position
from cpn_client.plan import Action, Approach, Goal, Model, Plan, Search
from cpn_client.requests import Exchange
from cpn_client.transport import AsyncTransport, Transport

T = TypeVar("T")


class Planner:
    """Connected planner. Threads may share it."""

    def __init__(self, transport: Transport, timeout_seconds: float) -> None:
        self._transport = transport
        self._timeout_seconds = timeout_seconds

    def __enter__(self) -> Planner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the connection."""
        self._transport.close()

    def plan(
        self,
        *,
        model: str,
        goal: Goal | ImageLike | Position,
        observation: ImageLike | Position,
        seed: int = 0,
        deadline_ms: int | None = None,
        search: Search | None = None,
        warm_start: Sequence[Action] = (),
        approach: Approach | None = None,
        steps_left: int | None = None,
        model_digest: str = "",
    ) -> Plan:
        """Plans the next actions towards the goal.

        While the planner is away the request is repeated until the deadline.

        Args:
            model: Name of the model.
            goal: Registered goal, image of the finished task, or target position, x, y, z in metres.
            observation: Camera image, or position of the hand, x, y, z in metres.
            seed: Seed of everything random: the same request and seed get the same plan from the same checkpoint,
                unless the search is anytime.
            deadline_ms: Longest wait for the plan, in milliseconds; the connection's timeout if None.
            search: Search for the actions; the model's own if None.
            warm_start: [horizon, A], initial plan of the search: `Plan.warm_start` of the step before.
            approach: `Plan.approach` of the step before, for a new target where the hand stalls; None at the first
                step, or to plan straight towards the goal. Not together with `search` or `warm_start`.
            steps_left: Number of steps that remain for the task, for models of the method te-bc-horizon.
            model_digest: SHA-256, in hex, of the checkpoint that must answer; any if empty.

        Raises:
            ValueError: If an image has the wrong type or shape, or a number is out of its range.
            UnreachableError: If there is no connection.
            NoPlannerError: If the connection leads to no planner.
            LateError: If no plan came in time.
            RefusedError: If the planner refused the request.
        """
        request = requests.plan_request(
            model=model,
            goal=goal,
            observation=observation,
            seed=seed,
            deadline_ms=deadline_ms,
            search=search,
            warm_start=warm_start,
            approach=approach,
            steps_left=steps_left,
            model_digest=model_digest,
        )
        return self._run(requests.plan(request, goal), deadline_ms)

    def goal(self, image: ImageLike) -> Goal:
        """Registers an image of the finished task, whose embedding is then computed once.

        Raises:
            ValueError: If the image has the wrong type or shape.
            PlannerError: As `plan`.
        """
        return self._run(requests.register(Image.of(image, field="goal")))

    def models(self) -> tuple[Model, ...]:
        """Lists the served models.

        Raises:
            PlannerError: As `plan`.
        """
        return self._run(requests.models())

    def episode(
        self,
        goal: Goal | ImageLike | Position,
        *,
        model: str,
        seed: int = 0,
        warm_start: bool = False,
        approaches: bool = True,
        deadline_ms: int | None = None,
        search: Search | None = None,
        with_fallback: Sequence[float] | None = None,
    ) -> Episode:
        """Episode towards a goal, all of whose plans come from one checkpoint.

        Args:
            goal: Registered goal, image of the finished task, or target position, x, y, z in metres.
            model: Name of the model.
            seed: Seed of the first plan; each step adds one.
            warm_start: Whether each search starts from the plan before, moved on by one step, in place of the policy's
                plan: for searches of many iterations.
            approaches: Whether, with a model of position dynamics, an episode without a search and warm starts tries
                the sides of the goal in turn where the hand stalls. False for an arm that must rest at the goal: the
                planner is not told of success.
            deadline_ms: Longest wait for an action, in milliseconds; the connection's timeout if None.
            search: Search for the actions; the model's own if None.
            with_fallback: Action, [A], in place of one that is late or whose planner is away or too busy; None for the
                error.

        Raises:
            ValueError: If the image has the wrong type or shape.
        """
        return Episode(
            self,
            goal,
            model=model,
            seed=seed,
            warm_start=warm_start,
            approaches=approaches,
            deadline_ms=deadline_ms,
            search=search,
            with_fallback=with_fallback,
        )

    def _run(self, exchange: Exchange[T], deadline_ms: int | None = None) -> T:
        deadline = Deadline(deadline_ms / 1000 if deadline_ms else self._timeout_seconds)
        step = partial(next, exchange)
        while True:
            try:
                request = step()
            except StopIteration as end:
                return end.value
            try:
                reply = Retrying(**retries(deadline))(self._transport.call, request, deadline)
            except PlannerError as error:
                step = partial(exchange.throw, error)
            else:
                step = partial(exchange.send, reply)


class AsyncPlanner:
    """Connected planner for asyncio, with the methods of `Planner`. Tasks of one loop may share it."""

    def __init__(self, transport: AsyncTransport, timeout_seconds: float) -> None:
        self._transport = transport
        self._timeout_seconds = timeout_seconds

    async def plan(
        self,
        *,
        model: str,
        goal: Goal | ImageLike | Position,
        observation: ImageLike | Position,
        seed: int = 0,
        deadline_ms: int | None = None,
        search: Search | None = None,
        warm_start: Sequence[Action] = (),
        approach: Approach | None = None,
        steps_left: int | None = None,
        model_digest: str = "",
    ) -> Plan:
        """Plans the next actions towards the goal; see `Planner.plan`."""
        request = requests.plan_request(
            model=model,
            goal=goal,
            observation=observation,
            seed=seed,
            deadline_ms=deadline_ms,
            search=search,
            warm_start=warm_start,
            approach=approach,
            steps_left=steps_left,
            model_digest=model_digest,
        )
        return await self._run(requests.plan(request, goal), deadline_ms)

    async def goal(self, image: ImageLike) -> Goal:
        """Registers an image of the finished task; see `Planner.goal`."""
        return await self._run(requests.register(Image.of(image, field="goal")))

    async def models(self) -> tuple[Model, ...]:
        """Lists the served models; see `Planner.models`."""
        return await self._run(requests.models())

    def episode(
        self,
        goal: Goal | ImageLike | Position,
        *,
        model: str,
        seed: int = 0,
        warm_start: bool = False,
        approaches: bool = True,
        deadline_ms: int | None = None,
        search: Search | None = None,
        with_fallback: Sequence[float] | None = None,
    ) -> AsyncEpisode:
        """Episode towards a goal, all of whose plans come from one checkpoint; see `Planner.episode`."""
        return AsyncEpisode(
            self,
            goal,
            model=model,
            seed=seed,
            warm_start=warm_start,
            approaches=approaches,
            deadline_ms=deadline_ms,
            search=search,
            with_fallback=with_fallback,
        )

    async def _run(self, exchange: Exchange[T], deadline_ms: int | None = None) -> T:
        deadline = Deadline(deadline_ms / 1000 if deadline_ms else self._timeout_seconds)
        step = partial(next, exchange)
        while True:
            try:
                request = step()
            except StopIteration as end:
                return end.value
            try:
                reply: bytes = await AsyncRetrying(**retries(deadline))(self._transport.call, request, deadline)
            except PlannerError as error:
                step = partial(exchange.throw, error)
            else:
                step = partial(exchange.send, reply)
