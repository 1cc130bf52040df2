"""Episode: plans of one checkpoint towards one goal, an action for each frame."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from cpn_client.errors import PlannerError, is_outage
from cpn_client.image import Image, ImageLike, Position, image_or_position
from cpn_client.plan import Action, Goal, Plan, Search

if TYPE_CHECKING:
    from cpn_client.planner import AsyncPlanner, Planner

log = logging.getLogger(__name__)


class _Steps:
    """State of an episode between its plans."""

    def __init__(
        self,
        goal: Goal | ImageLike | Position,
        *,
        model: str,
        seed: int,
        warm_start: bool,
        approaches: bool,
        deadline_ms: int | None,
        search: Search | None,
        with_fallback: Sequence[float] | None,
    ) -> None:
        self.steps = 0
        """Number of actions returned."""
        self.late = 0
        """Number of these that were the fallback."""
        self.plan: Plan | None = None
        """Last plan."""
        self._goal = goal if isinstance(goal, Goal) else image_or_position(goal, "goal")
        self._settings = {"model": model, "deadline_ms": deadline_ms, "search": search}
        self._seed = seed
        self._warm_start = warm_start
        self._approaches = approaches and not warm_start
        self._fallback = None if with_fallback is None else tuple(float(value) for value in with_fallback)

    def __exit__(self, *_: object) -> None:
        if self.late:
            log.warning("%d of %d actions of the episode were the fallback", self.late, self.steps)

    def _request(self, frame: ImageLike | Position, steps_left: int | None) -> dict[str, Any]:
        """Arguments of the next plan."""
        last = self.plan
        return self._settings | {
            "goal": self._goal,
            "observation": frame,
            "seed": self._seed + self.steps,
            "warm_start": last.warm_start if last and self._warm_start else (),
            "approach": last.approach if last and self._approaches else None,
            "model_digest": last.model_digest if last else "",
            "steps_left": steps_left,
        }

    def _planned(self, plan: Plan) -> Action:
        if isinstance(self._goal, Image):
            self._goal = Goal(plan.goal_id, self._goal)
        self.plan = plan
        self.steps += 1
        return plan.first_action

    def _missed(self, error: PlannerError) -> Action:
        if self._fallback is None or not is_outage(error):
            raise error
        self.late += 1
        self.steps += 1
        return self._fallback


class Episode(_Steps):
    """Episode of a `Planner`."""

    def __init__(self, planner: Planner, goal: Goal | ImageLike | Position, **settings: Any) -> None:  # noqa: ANN401
        super().__init__(goal, **settings)
        self._planner = planner

    def __enter__(self) -> Episode:
        return self

    def act(self, frame: ImageLike | Position, *, steps_left: int | None = None) -> Action:
        """Action to apply now, [A] in [-1, 1].

        Args:
            frame: Camera image, or position of the hand, x, y, z in metres.
            steps_left: Number of steps that remain for the task, for models of the method te-bc-horizon.

        Raises:
            PlannerError: As `Planner.plan`; without a fallback also if the planner is away, late or too busy.
        """
        try:
            plan = self._planner.plan(**self._request(frame, steps_left))
        except PlannerError as error:
            return self._missed(error)
        return self._planned(plan)


class AsyncEpisode(_Steps):
    """Episode of an `AsyncPlanner`."""

    def __init__(self, planner: AsyncPlanner, goal: Goal | ImageLike | Position, **settings: Any) -> None:  # noqa: ANN401
        super().__init__(goal, **settings)
        self._planner = planner

    def __enter__(self) -> AsyncEpisode:
        return self

    async def act(self, frame: ImageLike | Position, *, steps_left: int | None = None) -> Action:
        """Action to apply now; see `Episode.act`."""
        try:
            plan = await self._planner.plan(**self._request(frame, steps_left))
        except PlannerError as error:
            return self._missed(error)
        return self._planned(plan)
