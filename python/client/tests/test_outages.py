"""Late answers, and planners that are away."""

import threading

import pytest
import zenoh
from conftest import FRAME, GOAL, Connect, PlannerProcess, Variant, free_port, running
from fake import FAKES

import cpn_client
from cpn.v1 import planner_pb2, types_pb2
from cpn_client import LateError, NoPlannerError, Planner, RefusedError, Search, UnreachableError

HOLD = (0.0, 0.0, 0.0, -1.0)
PATIENCE_SECONDS = 60.0
SHORT_SECONDS = 1.0
"""Time for attempts that all fail."""


def test_late_answer_is_not_the_next_requests(connect: Connect, variant: Variant) -> None:
    first, second, sent = threading.Event(), threading.Event(), threading.Event()

    def answer(request: planner_pb2.PlanRequest) -> planner_pb2.PlanResponse:
        """Answers the first request after the second has arrived, and the second after that."""
        if request.seed == 1:
            first.set()
            assert second.wait(PATIENCE_SECONDS)
            threading.Timer(0.2, sent.set).start()
        else:
            second.set()
            assert sent.wait(PATIENCE_SECONDS)
        return planner_pb2.PlanResponse(goal_id=str(request.seed))

    with FAKES[variant.transport](answer) as address:
        planner = connect(address)
        with pytest.raises(LateError, match="no answer within 1000 ms"):
            planner.plan(model="m", goal=GOAL, observation=FRAME, seed=1, deadline_ms=1000)
        assert first.wait(PATIENCE_SECONDS)
        assert planner.plan(model="m", goal=GOAL, observation=FRAME, seed=2).goal_id == "2"


def test_frozen_planner_is_late(connect: Connect, variant: Variant, restartable: PlannerProcess) -> None:
    planner = connect(variant.address(restartable))
    asked = {"model": "random", "goal": GOAL, "observation": FRAME}
    expected = planner.plan(seed=2, **asked).actions
    restartable.freeze()
    with pytest.raises(LateError):
        planner.plan(seed=1, deadline_ms=300, **asked)
    restartable.thaw()
    assert planner.plan(seed=2, **asked).actions == expected


@pytest.mark.parametrize(
    ("code", "field", "attempts"),
    [
        (types_pb2.ERROR_CODE_RESOURCE_EXHAUSTED, "queue", 3),
        (types_pb2.ERROR_CODE_UNAVAILABLE, "", 3),
        (types_pb2.ERROR_CODE_RESOURCE_EXHAUSTED, "search", 1),
        (types_pb2.ERROR_CODE_INVALID_ARGUMENT, "model", 1),
        (types_pb2.ERROR_CODE_INTERNAL, "", 1),
    ],
)
def test_only_outages_are_retried(
    connect: Connect, variant: Variant, code: types_pb2.ErrorCode, field: str, attempts: int
) -> None:
    requests = []

    def answer(request: planner_pb2.PlanRequest) -> planner_pb2.PlanResponse | types_pb2.Error:
        requests.append(request)
        if len(requests) == 3:
            return planner_pb2.PlanResponse(goal_id="g")
        return types_pb2.Error(code=code, field=field, expected="other", got="this")

    with FAKES[variant.transport](answer) as address:
        planner = connect(address)
        if attempts == 3:
            assert planner.plan(model="m", goal=GOAL, observation=FRAME).goal_id == "g"
        else:
            with pytest.raises(RefusedError, match=f"{field}: expected other, got this"):
                planner.plan(model="m", goal=GOAL, observation=FRAME)
    assert len(requests) == attempts


def test_retries_end_with_the_deadline_and_the_last_error(connect: Connect, variant: Variant) -> None:
    deadlines = []

    def answer(request: planner_pb2.PlanRequest) -> types_pb2.Error:
        deadlines.append(request.deadline_ms)
        return types_pb2.Error(code=types_pb2.ERROR_CODE_RESOURCE_EXHAUSTED, field="queue")

    with FAKES[variant.transport](answer) as address:
        planner = connect(address)
        with pytest.raises(RefusedError, match="RESOURCE_EXHAUSTED queue"):
            planner.plan(model="m", goal=GOAL, observation=FRAME, deadline_ms=500)
    assert len(deadlines) > 1
    assert 500 >= deadlines[0] > deadlines[-1]


def test_outage_before_a_late_attempt_is_the_error(connect: Connect, variant: Variant) -> None:
    over, requests = threading.Event(), []

    def answer(request: planner_pb2.PlanRequest) -> types_pb2.Error:
        requests.append(request)
        if len(requests) > 1:
            assert over.wait(PATIENCE_SECONDS)
        return types_pb2.Error(code=types_pb2.ERROR_CODE_UNAVAILABLE, expected="an answer", got="none")

    with FAKES[variant.transport](answer) as address:
        planner = connect(address)
        with pytest.raises(RefusedError, match="expected an answer, got none"):
            planner.plan(model="m", goal=GOAL, observation=FRAME, deadline_ms=1000)
        over.set()


def test_planners_deadline_is_late(connect: Connect, variant: Variant) -> None:
    error = types_pb2.Error(code=types_pb2.ERROR_CODE_DEADLINE_EXCEEDED, field="deadline_ms")
    with FAKES[variant.transport](lambda _: error) as address:
        planner = connect(address)
        with pytest.raises(LateError):
            planner.plan(model="m", goal=GOAL, observation=FRAME)


def test_deadline_is_sent_along(connect: Connect, variant: Variant) -> None:
    deadlines = []

    def answer(request: planner_pb2.PlanRequest) -> planner_pb2.PlanResponse:
        deadlines.append(request.deadline_ms)
        return planner_pb2.PlanResponse()

    with FAKES[variant.transport](answer) as address:
        planner = connect(address)
        planner.plan(model="m", goal=GOAL, observation=FRAME, deadline_ms=60_000)
        planner.plan(model="m", goal=GOAL, observation=FRAME)
    assert 0 < deadlines[0] <= 60_000
    assert deadlines[1] == 0


def test_goal_is_registered_again_after_a_restart(
    connect: Connect, variant: Variant, restartable: PlannerProcess
) -> None:
    planner = connect(variant.address(restartable), timeout_seconds=PATIENCE_SECONDS)
    goal = planner.goal(GOAL)
    before = planner.plan(model="cpn", goal=goal, observation=FRAME)
    restartable.kill()
    restartable.start()
    after = planner.plan(model="cpn", goal=goal, observation=FRAME)
    assert (after.actions, after.goal_id) == (before.actions, goal.id)
    with pytest.raises(RefusedError, match="NOT_FOUND model"):
        planner.plan(model="nobody", goal=goal, observation=FRAME)


def test_planner_that_has_gone_is_unreachable(connect: Connect, variant: Variant, restartable: PlannerProcess) -> None:
    planner = connect(variant.address(restartable))
    restartable.kill()
    with pytest.raises(UnreachableError):
        planner.plan(model="cpn", goal=GOAL, observation=FRAME, deadline_ms=1000)


def test_request_waits_for_a_restart(connect: Connect, variant: Variant, restartable: PlannerProcess) -> None:
    planner = connect(variant.address(restartable), timeout_seconds=PATIENCE_SECONDS)
    restartable.kill()
    restart = threading.Timer(0.5, restartable.start)
    restart.start()
    assert len(planner.plan(model="cpn", goal=GOAL, observation=FRAME).actions) == 5
    restart.join()


def test_address_without_a_listener_is_unreachable(connect: Connect, variant: Variant) -> None:
    address = {"zenoh": "tcp/127.0.0.1:{}", "grpc": "grpc://127.0.0.1:{}"}[variant.transport].format(free_port())
    with pytest.raises(UnreachableError, match=address):
        connect(address, timeout_seconds=SHORT_SECONDS)


@pytest.mark.parametrize("variant", ["zenoh-sync", "zenoh-async"], indirect=True)
def test_router_without_the_planner_has_no_planner(connect: Connect, process: PlannerProcess) -> None:
    with pytest.raises(NoPlannerError, match="planner named 'other'"):
        connect(process.zenoh, name="other", timeout_seconds=SHORT_SECONDS)
    config, endpoint = zenoh.Config(), f"tcp/127.0.0.1:{free_port()}"
    for key, value in (("mode", '"router"'), ("listen/endpoints", f'["{endpoint}"]')):
        config.insert_json5(key, value)
    with zenoh.open(config), pytest.raises(NoPlannerError, match="planner named 'planner'"):
        connect(endpoint, timeout_seconds=SHORT_SECONDS)


@pytest.mark.parametrize("variant", ["zenoh-sync", "zenoh-async"], indirect=True)
def test_planner_is_found_by_name_and_namespace(connect: Connect) -> None:
    with running("--name", "p7", "--namespace", "lab") as process:
        assert connect(process.zenoh, name="p7", namespace="lab").models()
        with pytest.raises(NoPlannerError):
            connect(process.zenoh, name="p7", timeout_seconds=SHORT_SECONDS)


@pytest.mark.parametrize("variant", ["grpc-sync", "grpc-async"], indirect=True)
def test_other_server_of_grpc_has_no_planner(connect: Connect) -> None:
    from concurrent.futures import ThreadPoolExecutor

    import grpc

    with ThreadPoolExecutor() as threads:
        server = grpc.server(threads)
        port = server.add_insecure_port("127.0.0.1:0")
        server.start()
        with pytest.raises(NoPlannerError):
            connect(f"grpc://127.0.0.1:{port}", timeout_seconds=SHORT_SECONDS)
        server.stop(None).wait()


def test_episode_goes_on_with_its_fallback(connect: Connect, variant: Variant, restartable: PlannerProcess) -> None:
    planner = connect(variant.address(restartable))
    with planner.episode(GOAL, model="cpn", deadline_ms=10_000, with_fallback=HOLD) as episode:
        first = episode.act(FRAME)
        assert (episode.steps, episode.late) == (1, 0)
        digest = episode.plan.model_digest
        restartable.kill()
        with planner.episode(GOAL, model="cpn", deadline_ms=300, with_fallback=HOLD) as other:
            assert other.act(FRAME) == HOLD
            assert (other.steps, other.late, other.plan) == (1, 1, None)
        restartable.start()
        assert episode.act(FRAME) == first
        assert (episode.steps, episode.late, episode.plan.model_digest) == (2, 0, digest)


def test_search_too_long_for_its_deadline_is_the_fallback(planner: Planner, caplog: pytest.LogCaptureFixture) -> None:
    search = Search("cem", iterations=1000, samples=4096)
    settings = {"model": "cpn", "deadline_ms": 5, "search": search}
    with planner.episode(GOAL, with_fallback=HOLD, **settings) as episode:
        assert episode.act(FRAME) == HOLD
        assert episode.late == 1
    assert "1 of 1 actions" in caplog.text
    with planner.episode(GOAL, **settings) as episode, pytest.raises((LateError, RefusedError)):
        episode.act(FRAME)


def test_refusal_is_no_outage(planner: Planner) -> None:
    with planner.episode(GOAL, model="nobody", with_fallback=HOLD) as episode, pytest.raises(RefusedError):
        episode.act(FRAME)
    assert episode.late == 0


def test_episode_keeps_seed_warm_start_approach_and_checkpoint(connect: Connect, variant: Variant) -> None:
    requests = []

    def answer(request: planner_pb2.PlanRequest) -> planner_pb2.PlanResponse:
        requests.append(request)
        response = planner_pb2.PlanResponse(model_digest="d" * 64, goal_id="g" * 64)
        response.warm_start.add(values=[request.seed, 0.5])
        response.approach.MergeFrom(planner_pb2.Approach(tried=request.approach.tried + 1, position=[0, 0.5, 1]))
        response.first_action.values.extend([0.25, request.seed])
        return response

    with FAKES[variant.transport](answer) as address:
        planner = connect(address)
        with planner.episode(GOAL, model="m", seed=7, warm_start=True) as episode:
            actions = [episode.act(FRAME, steps_left=left) for left in (3, 2)]
        for approaches in (True, False):
            with planner.episode((0.5, 0.25, 1), model="m", approaches=approaches) as episode:
                for _ in range(2):
                    episode.act([0, 0.5, 1])
    assert actions == [(0.25, 7.0), (0.25, 8.0)]
    first, second, cold, later, _, direct = requests
    assert (first.seed, first.model_digest, first.steps_left) == (7, "", 3)
    assert first.goal_image.data == cpn_client.Image.of(GOAL).data
    assert (second.seed, second.model_digest, second.steps_left) == (8, "d" * 64, 2)
    assert second.goal_id == "g" * 64
    assert [list(action.values) for action in second.warm_start] == [[7.0, 0.5]]
    assert (later.goal_position.x, later.goal_position.y, later.goal_position.z) == (0.5, 0.25, 1)
    assert (later.position.x, later.position.y, later.position.z) == (0, 0.5, 1)
    assert not cold.warm_start
    assert not later.warm_start
    assert not any(request.HasField("approach") for request in (first, second, cold, direct))
    assert (later.approach.tried, list(later.approach.position), later.approach.plans) == (1, [0, 0.5, 1], 0)
