"""Benchmark of vla-eval over an environment of the simulator."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, DimSpec
from vla_eval.types import Action, EpisodeResult, Observation, Task


class GymnasiumBenchmark(StepBenchmark):
    def __init__(self, task: str, seed: int) -> None:
        super().__init__()
        self._env = gymnasium.make(f"cpn_sim_worker.gym:cpn/{task}-v0")
        self._tasks: list[Task] = [{"name": task, "seed": seed}]

    def get_tasks(self) -> list[Task]:
        return self._tasks

    def reset(self, task: Task) -> NDArray[np.uint8]:
        return self._env.reset(seed=task["seed"])[0]

    def step(self, action: Action) -> StepResult:
        frame, reward, terminated, truncated, info = self._env.step(action["actions"])
        return StepResult(frame, float(reward), terminated or truncated, info)

    def make_obs(self, raw_obs: NDArray[np.uint8], task: Task) -> Observation:
        return {"images": {"corner": raw_obs}, "task_description": task["name"]}

    def get_step_result(self, step_result: StepResult) -> EpisodeResult:
        return {"success": step_result.info["success"]}

    def get_action_spec(self) -> dict[str, DimSpec]:
        return {"actions": RAW}

    def get_observation_spec(self) -> dict[str, Any]:
        return {"image": IMAGE_RGB, "language": LANGUAGE}
