"""Policy that asks a planner for each action."""

from collections.abc import Sequence
from typing import Any, NoReturn, cast

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from numpy.typing import NDArray
from torch import Tensor

import cpn_client
from cpn_client import Episode, Image, Plan, Search
from lerobot_policy_cpn.configuration_cpn import UNTRAINABLE, CpnConfig

Pixels = NDArray[np.uint8]


class CpnPolicy(PreTrainedPolicy):
    """Policy of a remote planner, towards a goal image, from a file or observed; without weights and gradients.

    Each environment of a batch has an episode of its own, from `reset` to `reset`; its plans come from one checkpoint.
    """

    config_class = CpnConfig  # pyright: ignore[reportAssignmentType]
    name = "cpn"  # pyright: ignore[reportAssignmentType]

    def __init__(self, config: CpnConfig, **_: Any) -> None:  # noqa: ANN401
        """Reads the goal images and connects to the planner.

        Raises:
            ValueError: If the configuration has no goal image or no camera image, or the address or a setting of the
                environment is malformed.
            OSError: If a goal image cannot be read.
            cpn_client.PlannerError: If the address leads to no planner.
        """
        super().__init__(config)
        config.validate_features()
        self._goals = {task: Image.of(file, field="goals") for task, file in config.goals.items()}
        self._goal = Image.of(config.goal, field="goal") if config.goal else None
        self._approaches = config.approaches
        self._search = None if config.updates is None else Search(iterations=config.updates)
        self._image_key = config.camera_key
        self._goal_key = config.goal_key if config.observes_goal else None
        self._model, self._seed = config.model, config.seed
        self._planner = cpn_client.connect_from_environment(config.address)
        self.reset()

    def reset(self) -> None:
        """Ends the episodes; the next action begins new ones."""
        self._episodes: list[Episode] = []

    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> Tensor:  # noqa: ANN401
        """Plans of a batch, float32 [B, horizon, A] in [-1, 1].

        Args:
            batch: Camera images, [B, 3, height, width] in [0, 1], at `image_key`; goal images of the same shape at
                `goal_key`, which are read at the beginning of an episode and yield to image files; and at `task` the B
                descriptions of the tasks, without which all have the image file of the description "".

        Raises:
            ValueError: If a task has no goal image, or the size of the batch changes within an episode.
            cpn_client.PlannerError: If the planner refuses the request, or is away.
        """
        images = batch[self._image_key]
        if not self._episodes:
            tasks = batch.get("task") or [""] * len(images)
            observed = _pixels(batch[self._goal_key]) if self._goal_key else [None] * len(images)
            self._episodes = [self._episode(*goal) for goal in zip(tasks, observed, strict=True)]
        if len(images) != len(self._episodes):
            raise ValueError(
                f"{self._image_key}: expected a batch of {len(self._episodes)}, as since the last reset, "
                f"got one of {len(images)}"
            )
        plans = [_plan(episode, frame) for episode, frame in zip(self._episodes, _pixels(images), strict=True)]
        return torch.tensor(plans, dtype=torch.float32, device=images.device).clamp(-1, 1)

    def select_action(self, batch: dict[str, Any], **options: Any) -> Tensor:  # noqa: ANN401
        """Actions to apply now, float32 [B, A] in [-1, 1]; see `predict_action_chunk`."""
        return self.predict_action_chunk(batch, **options)[:, 0]

    def forward(self, batch: dict[str, Tensor]) -> NoReturn:
        """Raises `NotImplementedError`: the policy has no loss."""
        raise NotImplementedError(UNTRAINABLE)

    def get_optim_params(self) -> NoReturn:
        """Raises `NotImplementedError`: the policy has no parameters."""
        raise NotImplementedError(UNTRAINABLE)

    def _episode(self, task: str, observed: Pixels | None) -> Episode:
        """Episode towards the task's image file, or else towards the observed goal."""
        file = self._goals.get(task, self._goal)
        goal = observed if file is None else file
        if goal is None:
            raise ValueError(f"goals: expected an image file for {task!r}, got those for {', '.join(self._goals)}")
        return self._planner.episode(
            goal, model=self._model, seed=self._seed, approaches=self._approaches, search=self._search
        )


def _pixels(images: Tensor) -> Pixels:
    """Pixels, uint8 [B, height, width, 3], of images, [B, 3, height, width] in [0, 1]."""
    return (255 * images).round().to(torch.uint8).permute(0, 2, 3, 1).contiguous().numpy(force=True)


def _plan(episode: Episode, frame: Pixels) -> Sequence[Sequence[float]]:
    """Planned actions, [horizon, A], for a frame, uint8 [height, width, 3]."""
    episode.act(frame)
    return cast("Plan", episode.plan).actions
