"""Plans of a real planner with the shipped checkpoints."""

import asyncio
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import grpc
import numpy as np
import PIL.Image
import pytest
from conftest import FRAME, GOAL, PlannerProcess

import cpn_client
from cpn.v1 import planner_pb2, planner_pb2_grpc
from cpn_client import Plan, Planner, RefusedError, Search, StageTimes


def what(plan: Plan) -> Plan:
    """Plan without the facts of its request."""
    return replace(plan, times=StageTimes(0, 0, 0), request_bytes=0)


def test_plan_is_that_of_the_messages_alone(planner: Planner, process: PlannerProcess) -> None:
    plan = planner.plan(model="cpn", goal=GOAL, observation=FRAME, seed=3)
    pixels = [PIL.Image.open(path).convert("RGB").tobytes() for path in (GOAL, FRAME)]
    goal, frame = (cpn_client.Image(data).to_proto() for data in pixels)
    request = planner_pb2.PlanRequest(model="cpn", goal_image=goal, observation=frame, seed=3)
    with grpc.insecure_channel(process.grpc.removeprefix("grpc://")) as channel:
        expected = planner_pb2_grpc.PlannerServiceStub(channel).Plan(request)
    assert plan.actions == tuple(tuple(action.values) for action in expected.actions)
    assert plan.warm_start == tuple(tuple(action.values) for action in expected.warm_start)
    assert plan.first_action == tuple(expected.first_action.values)
    assert plan.inner_losses == tuple(expected.inner_losses)
    assert (plan.latent_distance, plan.iterations) == (expected.latent_distance, expected.iterations)
    assert (plan.model_digest, plan.goal_id) == (expected.model_digest, expected.goal_id)
    assert plan.times.plan_seconds > 0
    assert plan.request_bytes == request.ByteSize()
    assert np.asarray(plan.actions).shape == (5, 4)


def test_registered_goal_is_the_same_goal_and_weighs_less(planner: Planner) -> None:
    goal = planner.goal(GOAL)
    by_id = planner.plan(model="cpn", goal=goal, observation=FRAME)
    by_image = planner.plan(model="cpn", goal=GOAL, observation=FRAME)
    assert what(by_id) == what(by_image)
    assert by_id.goal_id == goal.id
    assert by_image.request_bytes - by_id.request_bytes > 84 * 84 * 3 - 100


def test_search_and_warm_start_are_the_planners(planner: Planner) -> None:
    search = Search("cem", iterations=3, samples=8)
    plan = planner.plan(model="cpn", goal=GOAL, observation=FRAME, search=search)
    assert plan.iterations_run == 3
    updated = planner.plan(model="cpn", goal=GOAL, observation=FRAME, search=Search(iterations=0))
    assert updated.iterations_run == 0
    warm = planner.plan(
        model="cpn", goal=GOAL, observation=FRAME, search=Search(iterations=0), warm_start=plan.warm_start
    )
    assert warm.actions == plan.warm_start
    anytime = planner.plan(
        model="cpn", goal=GOAL, observation=FRAME, deadline_ms=1000, search=Search("mppi", anytime=True)
    )
    assert anytime.iterations_run > 4


def test_random_model_depends_on_the_seed_alone(planner: Planner) -> None:
    one, same, other = (planner.plan(model="random", goal=GOAL, observation=FRAME, seed=seed) for seed in (1, 1, 2))
    assert what(one) == what(same) != what(other)
    assert one.latent_distance is None
    assert one.warm_start == ()


def test_models_are_those_of_the_folder(planner: Planner) -> None:
    models = {model.name: model for model in planner.models()}
    assert sorted(models) == ["bc", "cpn", "cpn-position", "random", "te-bc", "upn"]
    cpn = models["cpn"]
    assert (cpn.method, cpn.horizon, len(cpn.digest), len(cpn.training_tasks)) == ("cpn", 5, 64, 20)


@pytest.mark.parametrize(
    ("model", "wrong", "code", "field"),
    [
        ("nobody", {}, "NOT_FOUND", "model"),
        ("cpn", {"search": Search(samples=8)}, "INVALID_ARGUMENT", "search.samples"),
        ("cpn", {"observation": (0.1, 0.2, 0.3)}, "INVALID_ARGUMENT", "position"),
        ("cpn", {"model_digest": "0" * 64}, "FAILED_PRECONDITION", "model_digest"),
        ("cpn", {"warm_start": [(2000.0, 0.0, 0.0, 0.0)] * 5}, "INVALID_ARGUMENT", "warm_start"),
    ],
)
def test_refusals_name_code_and_field(
    planner: Planner, model: str, wrong: dict[str, Any], code: str, field: str
) -> None:
    request: dict[str, Any] = {"goal": GOAL, "observation": FRAME} | wrong
    with pytest.raises(RefusedError) as refused:
        planner.plan(model=model, **request)
    assert (refused.value.code, refused.value.field) == (code, field)
    assert refused.value.expected
    assert str(refused.value).startswith(f"{code} {field}: expected ")


def test_threads_get_their_own_plans(process: PlannerProcess) -> None:
    for address in (process.zenoh, process.grpc):
        with cpn_client.connect(address) as planner, ThreadPoolExecutor(8) as threads:

            def actions(seed: int, planner: cpn_client.Planner = planner) -> object:
                return planner.plan(model="random", goal=GOAL, observation=FRAME, seed=seed).actions

            assert list(threads.map(actions, range(64))) == [actions(seed) for seed in range(64)]


def test_tasks_get_their_own_plans(process: PlannerProcess) -> None:
    async def plans(address: str) -> list[Plan]:
        async with cpn_client.connect_async(address) as planner:
            requests = (
                planner.plan(model="random", goal=GOAL, observation=FRAME, seed=seed) for seed in [*range(32)] * 2
            )
            return await asyncio.gather(*requests)

    for address in (process.zenoh, process.grpc):
        actions = [plan.actions for plan in asyncio.run(plans(address))]
        assert actions[:32] == actions[32:]
        assert len(set(actions)) == 32


def test_cancelled_plan_leaves_the_connection_usable(process: PlannerProcess) -> None:
    asked = {"model": "cpn", "goal": GOAL, "observation": FRAME}
    long = Search("cem", samples=4096, anytime=True)

    async def plan(address: str) -> Plan:
        async with cpn_client.connect_async(address) as planner:
            task = asyncio.create_task(planner.plan(search=long, deadline_ms=2000, **asked))
            await asyncio.sleep(0.05)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            return await planner.plan(**asked)

    for address in (process.zenoh, process.grpc):
        assert asyncio.run(plan(address)).iterations_run == 1
