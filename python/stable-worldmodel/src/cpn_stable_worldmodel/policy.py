"""Policy that asks a planner for each action."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_worldmodel.policy import BasePolicy

from cpn_client import Episode, Planner, Search


class PlannerPolicy(BasePolicy):
    """Policy of a remote planner, towards the goal image of each environment.

    Each episode of an environment is one of the planner, whose plans come from one checkpoint.
    """

    def __init__(
        self,
        planner: Planner,
        *,
        model: str,
        search: Search | None = None,
        approaches: bool = True,
        first_seed: int = 0,
    ) -> None:
        """Makes the policy.

        Args:
            planner: Connected planner.
            model: Name of the model.
            search: Search for the actions; the model's own if None.
            approaches: Whether a model of position dynamics tries the sides of the goal in turn where the hand stalls;
                false for an arm that must rest at the goal, since the planner is not told of success.
            first_seed: Seed of the first plan of an episode; each step adds one.
        """
        super().__init__()
        self.type = "planner"
        self._planner = planner
        self._settings: dict[str, Any] = {
            "model": model,
            "search": search,
            "approaches": approaches,
            "seed": first_seed,
        }
        self._episodes: dict[int, Episode] = {}

    def get_action(self, obs: dict[str, Any], **_: Any) -> NDArray[np.float32]:  # noqa: ANN401
        """Actions to apply now, [N, A] in [-1, 1]; NaN for environments whose episode is over.

        Args:
            obs: Infos of a `World` with N environments, each [N, 1, ...]: `pixels` and `goal`, uint8
                [N, 1, height, width, 3], and `step_idx`, `terminated` and `truncated`, [N, 1].

        Raises:
            ValueError: If there is no `pixels` or `goal`, or their type or shape is wrong.
            cpn_client.PlannerError: If the planner refuses a request, or is away.
        """
        for key in ("pixels", "goal"):
            if key not in obs:
                raise ValueError(f"infos: expected {key}, an image, got {', '.join(obs)}")
        actions = np.full(self.env.action_space.shape, np.nan, np.float32)
        over = (obs["terminated"] | obs["truncated"])[:, -1]
        for index in np.flatnonzero(~over).tolist():
            if obs["step_idx"][index, -1] == 0:
                self._episodes[index] = self._planner.episode(obs["goal"][index, -1], **self._settings)
            actions[index] = self._episodes[index].act(obs["pixels"][index, -1])
        return actions
