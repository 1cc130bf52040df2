"""Policy in an unmodified stable-worldmodel, with a planner and the simulator's environments."""

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import stable_worldmodel as swm

import cpn_client
from cpn_client import RefusedError, Search
from cpn_stable_worldmodel import PlannerPolicy

ID = "cpn_sim_worker.gym:cpn/{}-v0"
SEED = 1_000_000


@pytest.fixture(scope="module")
def planner(address: str) -> Iterator[cpn_client.Planner]:
    with cpn_client.connect(address) as planner:
        yield planner


def world(task: str, policy: PlannerPolicy, **options: Any) -> swm.World:  # noqa: ANN401
    settings: dict[str, Any] = {"num_envs": 1, "image_shape": (84, 84), "goal_image": True} | options
    envs = swm.World(ID.format(task), **settings)
    envs.set_policy(policy)
    envs.reset(seed=SEED)
    return envs


def solved(planner: cpn_client.Planner, task: str, seed: int) -> bool:
    """Whether the client alone solves a variation within 150 steps."""
    env = gymnasium.make(ID.format(task), goal_image=True)
    frame, info = env.reset(seed=seed)
    with planner.episode(info["goal"], model="cpn") as episode:
        terminated = truncated = False
        while not (terminated or truncated):
            frame, _, terminated, truncated, _ = env.step(episode.act(frame))
    return terminated


def test_actions_are_those_of_the_client(planner: cpn_client.Planner) -> None:
    search = Search(iterations=3)
    policy = PlannerPolicy(planner, model="cpn", search=search, first_seed=7)
    envs = world("plate-slide", policy, num_envs=2)
    for step in range(2):
        actions = policy.get_action(envs.infos)
        expected = [
            planner.plan(model="cpn", goal=goal[0], observation=pixels[0], seed=7 + step, search=search).first_action
            for goal, pixels in zip(envs.infos["goal"], envs.infos["pixels"], strict=True)
        ]
        assert (actions.dtype, actions.shape) == (np.float32, (2, 4))
        assert np.array_equal(actions, np.array(expected, np.float32))
        envs.infos = envs.envs.step(actions)[-1]


def test_approaches_lead_beside_the_goal_where_the_hand_stalls(planner: cpn_client.Planner) -> None:
    for approaches, number in ((True, 2), (False, 1)):
        policy = PlannerPolicy(planner, model="cpn-position", approaches=approaches)
        infos = world("drawer-close", policy).infos
        actions = [policy.get_action(infos | {"step_idx": np.full((1, 1), step)}) for step in range(10)]
        assert len({action.tobytes() for action in actions}) == number


def test_each_episode_begins_anew_and_a_finished_one_is_not_planned(planner: cpn_client.Planner) -> None:
    policy = PlannerPolicy(planner, model="random")
    envs = world("reach", policy, num_envs=2, max_episode_steps=1)
    first = policy.get_action(envs.infos)
    _, _, _, truncated, infos = envs.envs.step(first, mask=np.array([True, False]))
    assert truncated.tolist() == [True, False]
    second = policy.get_action(infos)
    assert np.isnan(second[0]).all()
    assert not np.isnan(second[1]).any()
    _, infos = envs.envs.reset(seed=[SEED, None], mask=np.array([True, False]))
    assert np.array_equal(policy.get_action(infos)[0], first[0])


def test_world_evaluates_the_planner(planner: cpn_client.Planner) -> None:
    envs = world("plate-slide", PlannerPolicy(planner, model="cpn"), max_episode_steps=150)
    results = envs.evaluate(episodes=2, seed=SEED)
    assert results["seeds"].tolist() == [SEED, SEED + 1]
    successes = [solved(planner, "plate-slide", seed) for seed in (SEED, SEED + 1)]
    assert results["episode_successes"].astype(bool).tolist() == successes
    assert any(successes)


def test_faulty_requests_are_refused(planner: cpn_client.Planner) -> None:
    policy = PlannerPolicy(planner, model="cpn")
    with pytest.raises(ValueError, match=r"infos: expected goal, an image, got .*pixels"):
        policy.get_action(world("reach", policy, goal_image=False).infos)
    stranger = PlannerPolicy(planner, model="nobody")
    with pytest.raises(RefusedError, match="NOT_FOUND model"):
        stranger.get_action(world("reach", stranger).infos)
