"""Model server in an unmodified vla-eval, and a planner with the shipped checkpoints."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import gymnasium
import numpy as np
import PIL.Image
import pytest
from conftest import FRAME, GOAL
from numpy.typing import NDArray
from vla_eval.api import evaluate, serve_background
from vla_eval.connection import Connection

import cpn_client
from cpn_client import Search
from cpn_vla_eval import PlannerModelServer

SEED = 1_000_000


def pixels(file: Path) -> NDArray[np.uint8]:
    return np.asarray(PIL.Image.open(file).convert("RGB"))


def observation(file: Path = FRAME, **others: Any) -> dict[str, Any]:  # noqa: ANN401
    return {"images": {"corner": pixels(file)}} | others


def actions(server: PlannerModelServer, *episodes: list[dict[str, Any]]) -> list[NDArray[np.float32]]:
    """Actions of a served model server, one for each observation of each episode of a session."""

    async def ask(url: str) -> list[NDArray[np.float32]]:
        answers: list[NDArray[np.float32]] = []
        async with Connection(url) as connection:
            for episode in episodes:
                await connection.start_episode({"task": {}})
                answers += [(await connection.act(obs))["actions"] for obs in episode]
                await connection.end_episode({})
        return answers

    with serve_background(server) as served:
        return anyio.run(ask, served.url)


@pytest.fixture
def planned(address: str) -> Callable[..., NDArray[np.float32]]:
    """First action of a plan by the client alone, [A]."""

    def plan(**others: Any) -> NDArray[np.float32]:  # noqa: ANN401
        with cpn_client.connect(address) as planner:
            request = {"model": "cpn", "goal": GOAL, "observation": FRAME} | others
            return np.array(planner.plan(**request).first_action, np.float32)

    return plan


def test_actions_are_those_of_the_client(address: str, planned: Callable[..., NDArray[np.float32]]) -> None:
    (action,) = actions(PlannerModelServer(address, goal=str(GOAL)), [observation()])
    assert np.array_equal(action, planned())
    assert (action.dtype, action.shape) == (np.float32, (4,))
    (action,) = actions(PlannerModelServer(address, model="te-bc", goal=str(GOAL)), [observation()])
    assert np.array_equal(action, planned(model="te-bc"))
    (action,) = actions(PlannerModelServer(address, goal=str(GOAL), updates=3), [observation()])
    assert np.array_equal(action, planned(search=Search(iterations=3)))


def test_seed_counts_the_steps_of_each_episode(address: str, planned: Callable[..., NDArray[np.float32]]) -> None:
    server = PlannerModelServer(address, model="random", goal=str(GOAL), seed=5)
    got = actions(server, [observation()] * 2, [observation()])
    expected = [planned(model="random", seed=seed) for seed in (5, 6, 5)]
    assert np.array_equal(got, expected)


def test_approaches_lead_beside_the_goal_where_the_hand_stalls(address: str) -> None:
    for approaches, number in ((True, 2), (False, 1)):
        server = PlannerModelServer(address, model="cpn-position", goal=str(GOAL), approaches=approaches)
        got = actions(server, [observation()] * 10)
        assert len({action.tobytes() for action in got}) == number


def test_each_task_has_its_goal_and_the_camera_is_chosen(
    address: str, planned: Callable[..., NDArray[np.float32]]
) -> None:
    server = PlannerModelServer(address, goal=str(GOAL), goals={"other": str(FRAME)}, camera="corner")
    two = observation(task_description="other")
    two["images"]["wrist"] = pixels(GOAL)
    got = actions(server, [two], [observation(task_description="this")])
    assert np.array_equal(got, [planned(goal=FRAME), planned()])


def test_faulty_requests_are_refused_and_the_next_is_answered(
    address: str, planned: Callable[..., NDArray[np.float32]]
) -> None:
    server = PlannerModelServer(address, goals={"other": str(FRAME)})
    two = {"images": {"a": pixels(FRAME), "b": pixels(FRAME)}, "task_description": "other"}
    for obs, error in [
        (two, "images: expected one camera, got a, b"),
        ({"task_description": "other"}, "images: expected one camera, got none"),
        (observation(task_description="this"), "goals: expected an image file for 'this', got those for other"),
    ]:
        with pytest.raises(RuntimeError, match=error):
            actions(server, [obs])
    (action,) = actions(server, [observation(task_description="other")])
    assert np.array_equal(action, planned(goal=FRAME))
    with pytest.raises(RuntimeError, match="NOT_FOUND model"):
        actions(PlannerModelServer(address, model="nobody", goal=str(GOAL)), [observation()])
    with pytest.raises(RuntimeError, match="images: expected wrist, got corner"):
        actions(PlannerModelServer(address, goal=str(GOAL), camera="wrist"), [observation()])


def test_faulty_settings_are_refused(address: str) -> None:
    with pytest.raises(ValueError, match="goal: expected an image file of the finished task, or goals, got neither"):
        PlannerModelServer(address)
    with pytest.raises(FileNotFoundError, match=r"missing\.png"):
        PlannerModelServer(address, goal="missing.png")
    with pytest.raises(ValueError, match="address: expected a zenoh endpoint"):
        PlannerModelServer("somewhere", goal=str(GOAL))


def test_vla_eval_evaluates_the_planner(address: str, tmp_path: Path) -> None:
    goal = tmp_path / "goal.png"
    env = gymnasium.make("cpn_sim_worker.gym:cpn/plate-slide-v0", goal_image=True)
    PIL.Image.fromarray(env.reset(seed=SEED)[1]["goal"]).save(goal)
    benchmark = {
        "benchmark": "gymnasium_benchmark:GymnasiumBenchmark",
        "params": {"task": "plate-slide", "seed": SEED},
        "max_steps": 150,
    }
    config = {"benchmarks": [benchmark], "output_dir": str(tmp_path)}
    server = PlannerModelServer(address, goals={"plate-slide": str(goal)})
    (result,) = evaluate(server, config, no_save=True, docker=False)
    assert result["mean_success"] == 1


def test_command_serves_on_the_loopback_interface(address: str) -> None:
    command = [str(Path(sys.executable).with_name("cpn-vla-eval")), "--port", "0"]
    command += ["--args.address", address, "--args.goal", str(GOAL)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr
        assert any("Starting server on ws://127.0.0.1:0" in line for line in process.stderr)
        process.kill()
