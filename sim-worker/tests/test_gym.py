"""Gymnasium environments of the scenes."""

import warnings
from functools import partial
from itertools import islice
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv

from cpn_sim_worker.expert import ExpertFailedError, solve
from cpn_sim_worker.gym import SceneEnv
from cpn_sim_worker.simulator import Simulator
from cpn_sim_worker.tasks import FIRST_EVALUATION_SEED, JENGA_TASKS, METAWORLD_TASKS, SeedError, UnknownTaskError
from tests.support import UNSOLVED

SEED = FIRST_EVALUATION_SEED


def make(task: str, **options: Any) -> gymnasium.Env:  # noqa: ANN401
    return gymnasium.make(f"cpn_sim_worker.gym:cpn/{task}-v0", **options)


def test_every_task_has_an_id() -> None:
    ids = {name for name in gymnasium.registry if name.startswith("cpn/")}
    assert ids == {f"cpn/{task}-v0" for task in METAWORLD_TASKS + JENGA_TASKS}


@pytest.mark.parametrize(("task", "goal_image"), [("reach", True), ("jenga-poke", False)])
def test_gymnasium_finds_no_fault(task: str, goal_image: bool) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(task, goal_image=goal_image).unwrapped)


@pytest.mark.parametrize("task", ["door-lock", "jenga-poke"])
def test_episode_is_that_of_the_simulator(simulator: Simulator, task: str) -> None:
    moments = [(moment, simulator.frame()) for moment in solve(simulator, task, SEED)]
    goal = simulator.frame()
    env = make(task, goal_image=True)
    frame, info = env.reset(seed=SEED)
    assert np.array_equal(info["goal"], goal)
    assert (info["seed"], info["success"]) == (SEED, False)
    reward, terminated = 0.0, False
    for moment, expected in moments:
        assert np.array_equal(frame, expected)
        assert np.array_equal(info["state"], moment.arrival.state)
        assert (reward, terminated, info["success"]) == (
            moment.arrival.reward,
            moment.arrival.success,
            moment.arrival.success,
        )
        if terminated:
            break
        frame, reward, terminated, truncated, info = env.step(moment.action)
        assert not truncated
    assert terminated


def test_two_environments_are_alike_and_taking_turns_changes_nothing() -> None:
    def episode(seed: int | None):  # noqa: ANN202
        env = make("door-lock")
        env.reset(seed=7)
        frame, info = env.reset(seed=seed)
        env.action_space.seed(7)
        while True:
            yield frame, info["state"]
            frame, _, _, _, info = env.step(env.action_space.sample())

    for seed in (SEED, None):
        turns = list(islice(zip(episode(seed), episode(seed), strict=True), 4))
        alone = list(islice(episode(seed), 4))
        for (one, other), same in zip(turns, alone, strict=True):
            for values in zip(one, other, same, strict=True):
                assert np.array_equal(values[0], values[1])
                assert np.array_equal(values[0], values[2])


def test_environments_in_processes_of_their_own_are_alike(simulator: Simulator) -> None:
    simulator.reset("reach", SEED)
    # Spawned, since this process has drawn already.
    envs = AsyncVectorEnv([partial(make, "reach")] * 2, context="spawn")
    try:
        frames, info = envs.reset(seed=[SEED, SEED])
    finally:
        envs.close()
    assert np.array_equal(frames, np.stack([simulator.frame()] * 2))
    assert list(info["seed"]) == [SEED, SEED]


def test_drawn_variations_are_of_demonstrations_and_solved_by_the_expert() -> None:
    env = make("door-open", goal_image=True)
    seeds = [env.reset(seed=1)[1]["seed"]] + [env.reset()[1]["seed"] for _ in range(3)]
    assert seeds[0] == 1
    assert len(set(seeds)) == 4
    assert max(seeds) < FIRST_EVALUATION_SEED


def test_variation_that_the_expert_fails_is_drawn_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    task, seed = UNSOLVED
    env = SceneEnv(task, goal_image=True)
    with pytest.raises(ExpertFailedError, match="door-open with seed 2"):
        env.reset(seed=seed)
    monkeypatch.setattr(env, "_np_random", Draws(seed, seed + 1))
    assert env.reset()[1]["seed"] == seed + 1
    assert SceneEnv(task).reset(seed=seed)[1]["seed"] == seed


class Draws:
    """Generator that draws these numbers."""

    def __init__(self, *numbers: int) -> None:
        self._numbers = iter(numbers)

    def integers(self, _: int) -> int:
        return next(self._numbers)


def test_episode_is_truncated() -> None:
    env = make("door-lock", max_episode_steps=2)
    env.reset(seed=SEED)
    ends = [env.step(np.zeros(4, np.float32))[2:4] for _ in range(2)]
    assert ends == [(False, False), (False, True)]
    spec = make("reach").spec
    assert spec is not None
    assert spec.max_episode_steps == 150


def test_rendered_image_is_the_observation() -> None:
    env = make("reach", render_mode="rgb_array")
    frame, _ = env.reset(seed=SEED)
    assert np.array_equal(env.render(), frame)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("action", [[0, 0, 1], [0, 0, 0, 1.5], [0, 0, 0, float("nan")]])
def test_faulty_action_is_refused(action: list[float]) -> None:
    env = make("reach")
    env.reset(seed=SEED)
    with pytest.raises(ValueError, match=r"action: expected \(4,\) in \[-1, 1\], got \["):
        env.step(np.array(action))


def test_faulty_arguments_are_refused() -> None:
    with pytest.raises(UnknownTaskError, match="door-lok"):
        SceneEnv("door-lok")
    with pytest.raises(ValueError, match=r"options: expected none, got \{'task': 'reach'\}"):
        make("door-lock").reset(options={"task": "reach"})
    with pytest.raises(SeedError, match="seed of jenga-poke-offset: expected at least 1000000, got 3"):
        make("jenga-poke-offset").reset(seed=3)
