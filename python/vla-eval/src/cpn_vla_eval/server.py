"""Model server that asks a planner for each action."""

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vla_eval.model_servers.base import SessionContext
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import run_server
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, DimSpec
from vla_eval.types import Action, Observation

import cpn_client
from cpn_client import Episode, Image, Search


class PlannerModelServer(PredictModelServer):
    """Model server of a remote planner, towards a goal image; without weights.

    Each episode of a session is one of the planner, whose plans come from one checkpoint.
    """

    def __init__(
        self,
        address: str = "",
        model: str = "cpn",
        goal: str = "",
        goals: dict[str, str] | None = None,
        camera: str = "",
        updates: int | None = None,
        approaches: bool = True,
        seed: int = 0,
    ) -> None:
        """Reads the goal images and connects to the planner.

        Args:
            address: Zenoh endpoint of the planner or of a router, or `grpc://HOST:PORT` or `grpcs://HOST:PORT`; by
                default `CPN_CONNECT`. Name, namespace, certificates and token come from the environment, see
                `cpn_client.connect_from_environment`.
            model: Name of the planner's model.
            goal: Image file of the finished task, for tasks without one in `goals`.
            goals: Image files of the finished task, by the task's description.
            camera: Name of the camera; may be left out where observations have one image.
            updates: Number of updates of a plan; the model's own if None.
            approaches: Whether a model of position dynamics tries the sides of the goal in turn where the hand stalls;
                false for an arm that must rest at the goal, since the planner is not told of success.
            seed: Seed of the first plan of an episode; each step adds one.

        Raises:
            ValueError: If there is no goal image, or the address or a setting of the environment is malformed.
            OSError: If a goal image cannot be read.
            cpn_client.PlannerError: If the address leads to no planner.
        """
        super().__init__()
        self._goals = {task: Image.of(file, field="goals") for task, file in (goals or {}).items()}
        self._goal = Image.of(goal, field="goal") if goal else None
        if not self._goals and self._goal is None:
            raise ValueError("goal: expected an image file of the finished task, or goals, got neither")
        self._camera = camera
        search = None if updates is None else Search(iterations=updates)
        self._settings: dict[str, Any] = {"model": model, "search": search, "approaches": approaches, "seed": seed}
        self._planner = cpn_client.connect_from_environment(address)
        self._episodes: dict[str, Episode] = {}

    def predict(self, obs: Observation, ctx: SessionContext) -> Action:
        """Action to apply now.

        Args:
            obs: Observation with the camera's image in `images`, uint8 [height, width, 3], and the `task_description`,
                without which the task has the goal of the description "".
            ctx: Session.

        Returns:
            The `actions`, float32 [A] in [-1, 1].

        Raises:
            ValueError: If there is no image of the camera, its type or shape is wrong, or the task has no goal image.
            cpn_client.PlannerError: If the planner refuses the request, or is away.
        """
        image = self._image(obs.get("images", {}))
        if ctx.is_first:
            self._episodes[ctx.session_id] = self._episode(obs.get("task_description", ""))
        return {"actions": np.array(self._episodes[ctx.session_id].act(image), np.float32)}

    async def on_episode_end(self, result: dict[str, Any], ctx: SessionContext) -> None:
        """Ends the planner's episode."""
        await super().on_episode_end(result, ctx)
        self._episodes.pop(ctx.session_id, None)

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Actions as the benchmark's own; the planner's model was trained on them."""
        return {"actions": RAW}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """One image, and the description of the task."""
        return {"image": IMAGE_RGB, "language": LANGUAGE}

    def _image(self, images: dict[str, NDArray[np.uint8]]) -> NDArray[np.uint8]:
        if self._camera in images:
            return images[self._camera]
        if self._camera or len(images) != 1:
            raise ValueError(f"images: expected {self._camera or 'one camera'}, got {', '.join(images) or 'none'}")
        return next(iter(images.values()))

    def _episode(self, task: str) -> Episode:
        goal = self._goals.get(task, self._goal)
        if goal is None:
            raise ValueError(f"goals: expected an image file for {task!r}, got those for {', '.join(self._goals)}")
        return self._planner.episode(goal, **self._settings)


def main() -> None:
    """Command `cpn-vla-eval`, with vla-eval's options: `--address HOST:PORT`, and `--args.goal FILE` and the like."""
    # vla-eval's own default is every interface, in plain text.
    sys.argv[1:1] = ["--host", "127.0.0.1"]
    run_server(PlannerModelServer)
