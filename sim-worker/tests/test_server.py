import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np
import pytest
import zenoh
from metaworld.sawyer_xyz_env import SawyerXYZEnv

from cpn.v1 import sim_pb2, types_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.episode import EpisodeRunner, _Episode
from cpn_sim_worker.options import MAX_STEPS, ServeConfig
from cpn_sim_worker.server import QUEUE_LENGTH, NameTakenError, SimServer, claim_name
from cpn_sim_worker.session import StoppedError, UnavailableError, ZenohConfig, ask, is_connected, open_session
from cpn_sim_worker.simulator import Simulator
from cpn_sim_worker.tasks import FIRST_EVALUATION_SEED
from cpn_sim_worker.wire import MAX_PAYLOAD_BYTES, RequestError, decode, encoding
from tests.support import (
    COMMAND,
    READY_SECONDS,
    UNSOLVED,
    StartWorker,
    client,
    collect,
    free_endpoint,
    pixels,
    router,
    wait_for,
    wait_for_sample,
)

SEED = FIRST_EVALUATION_SEED + 1
REST = (0.0, 0.0, 0.0, 0.0)


class Worker:
    """Client of one worker."""

    def __init__(self, session: zenoh.Session, name: str) -> None:
        self.session = session
        self.name = name

    def reset(self, task: str = "reach", seed: int = SEED, goal_seed: int | None = None) -> sim_pb2.ResetResponse:
        request = sim_pb2.ResetRequest(variation=types_pb2.Variation(task=task, seed=seed), goal_seed=goal_seed)
        return ask(self.session, keys.sim_reset(self.name), request, sim_pb2.ResetResponse, READY_SECONDS)

    def step(self, episode_id: str, step: int, values: tuple[float, ...] = REST) -> sim_pb2.StepResponse:
        request = sim_pb2.StepRequest(episode_id=episode_id, step=step, action=types_pb2.Action(values=values))
        return ask(self.session, keys.sim_step(self.name), request, sim_pb2.StepResponse, READY_SECONDS)

    def error(self, key: str, payload: bytes) -> types_pb2.Error:
        """Error reply to raw bytes."""
        (reply,) = self.session.get(key, payload=payload, timeout=READY_SECONDS)
        assert reply.err is not None
        assert str(reply.err.encoding) == encoding(types_pb2.Error)
        return decode(types_pb2.Error, reply.err.payload.to_bytes())


@pytest.fixture(scope="module")
def worker(session: zenoh.Session, start_worker: StartWorker) -> Worker:
    start_worker("w0", "--max-steps", "6")
    return Worker(session, "w0")


def test_episode_runs_to_its_last_step(worker: Worker) -> None:
    start = worker.reset()
    assert start.max_steps == 6
    first = pixels(start.observation)
    assert not np.array_equal(first, pixels(start.goal))
    responses = [worker.step(start.episode_id, step, (0, 0, 1, 0)) for step in range(6)]
    assert [response.done for response in responses] == [False] * 5 + [True]
    assert not any(response.success for response in responses)
    assert not np.array_equal(first, pixels(responses[-1].observation))
    with pytest.raises(RequestError, match=r"FAILED_PRECONDITION episode_id: .*one that ended after 6 steps"):
        worker.step(start.episode_id, 6)


def test_reset_is_reproducible_and_ends_the_episode_before(worker: Worker) -> None:
    first, second = worker.reset(), worker.reset()
    assert first.episode_id != second.episode_id
    assert (first.goal, first.observation) == (second.goal, second.observation)
    with pytest.raises(RequestError, match="NOT_FOUND episode_id") as caught:
        worker.step(first.episode_id, 0)
    assert second.episode_id in caught.value.expected
    assert first.episode_id in caught.value.got


def test_reset_tells_where_the_hand_is_in_the_goal_image(worker: Worker) -> None:
    """Towards it, an action of 1 displaces the hand by so many metres."""
    start, other = worker.reset(), worker.reset(goal_seed=SEED + 1)
    assert other.goal_hand_position == worker.reset(seed=SEED + 1).goal_hand_position != start.goal_hand_position
    start = worker.reset()
    assert (start.control.action_size, start.control.metres) == (4, pytest.approx(0.01))
    assert start.control.hz == pytest.approx(80)
    assert not start.success
    goal, hand, progress = np.array(start.goal_hand_position), start.hand_position, [start.progress]
    distances = [np.linalg.norm(goal - hand)]
    for step in range(6):
        action = np.append(np.clip((goal - hand) / start.control.metres, -1, 1), 0)
        response = worker.step(start.episode_id, step, tuple(action))
        hand = response.hand_position
        distances.append(np.linalg.norm(goal - hand))
        progress.append(response.progress)
    assert distances[-1] < distances[0] - 0.02
    # The task is to reach that point.
    assert sorted(progress) == progress
    assert progress[0] < progress[-1] < 1


def test_goal_of_another_variation(worker: Worker) -> None:
    here, there = worker.reset(seed=SEED), worker.reset(seed=SEED + 1)
    mixed = worker.reset(seed=SEED, goal_seed=SEED + 1)
    assert (mixed.observation, mixed.goal) == (here.observation, there.goal)
    assert here.goal != there.goal
    task, unsolved = UNSOLVED
    with pytest.raises(RequestError, match=f"FAILED_PRECONDITION goal_seed: .*, got {unsolved}$"):
        worker.reset(task, unsolved + 1, goal_seed=unsolved)
    with pytest.raises(RequestError, match=rf"FAILED_PRECONDITION variation\.seed: .*, got {unsolved}$"):
        worker.reset(task, unsolved, goal_seed=unsolved + 1)


def test_jenga_is_served_by_the_same_worker(worker: Worker) -> None:
    start = worker.reset("jenga-poke-offset", SEED)
    assert len(start.goal_position) == 3
    assert start.goal.render_spec == start.observation.render_spec != worker.reset().observation.render_spec
    start = worker.reset("jenga-poke-offset", SEED)
    with pytest.raises(RequestError, match=r"INVALID_ARGUMENT action.values: expected 3 values, got 4"):
        worker.step(start.episode_id, 0)
    response = worker.step(start.episode_id, 0, (1, 0, 0))
    assert -1 < response.reward < 0
    moved = np.subtract(response.hand_position, start.hand_position)
    assert 0.002 < moved[0] < 0.01
    assert np.abs(moved[1:]).max() < 0.002
    assert (start.control.action_size, start.control.metres, start.control.hz) == (3, 0.01, 10)
    from_goal = np.subtract(response.hand_position, start.goal_position)
    assert response.reward == pytest.approx(-np.linalg.norm(from_goal), abs=1e-6)
    assert not worker.reset().goal_position
    with pytest.raises(RequestError, match=r"INVALID_ARGUMENT variation.seed: expected at least 1000000, got 3"):
        worker.reset("jenga-poke-offset", 3)
    worker.reset()


def test_task_without_its_extra_is_refused(simulator: Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dm_control", None)
    runner = EpisodeRunner(Simulator(simulator._renderer), max_steps=1)
    request = sim_pb2.ResetRequest(variation=types_pb2.Variation(task="jenga-poke", seed=SEED))
    with pytest.raises(RequestError, match=r"FAILED_PRECONDITION variation\.task: expected .* extra jenga, got"):
        runner.reset(request)


def test_step_is_applied_exactly_once(worker: Worker) -> None:
    up = (0.0, 0.0, 1.0, 0.0)
    once = worker.reset().episode_id
    expected = [worker.step(once, step, up) for step in range(3)]
    repeated = worker.reset().episode_id
    for step in range(3):
        assert [worker.step(repeated, step, up) for _ in range(3)] == [expected[step]] * 3


@pytest.mark.parametrize(("step", "values"), [(2, REST), (0, (0.5, 0, 0, 0)), (7, REST)])
def test_step_out_of_order_is_refused(worker: Worker, step: int, values: tuple[float, ...]) -> None:
    """A gap, another action under a number already used, and a number beyond the end."""
    episode = worker.reset().episode_id
    worker.step(episode, 0)
    with pytest.raises(RequestError, match=f"FAILED_PRECONDITION step: expected 1, got {step}"):
        worker.step(episode, step, values)
    assert not worker.step(episode, 1).done


@pytest.mark.parametrize("values", [(0, 0, 0), (float("nan"), 0, 0, 0), (0, 0, 0, 2)])
def test_bad_action_is_refused_and_not_applied(worker: Worker, values: tuple[float, ...]) -> None:
    episode = worker.reset().episode_id
    with pytest.raises(RequestError, match=r"INVALID_ARGUMENT action\.values"):
        worker.step(episode, 0, values)
    worker.step(episode, 0)


def test_refused_reset_leaves_the_episode_running(worker: Worker) -> None:
    episode = worker.reset().episode_id
    with pytest.raises(RequestError, match=r"INVALID_ARGUMENT variation.task: expected one of .*, got 'juggle'"):
        worker.reset(task="juggle")
    worker.step(episode, 0)


def test_variation_beyond_the_expert_is_refused(worker: Worker) -> None:
    with pytest.raises(RequestError, match=r"FAILED_PRECONDITION variation\.seed"):
        worker.reset(*UNSOLVED)
    worker.reset()


@pytest.mark.parametrize("key", [keys.sim_reset, keys.sim_step])
@pytest.mark.parametrize("payload", [b"\x0a\x7f", b"\xff" * 12, b"\0" * (MAX_PAYLOAD_BYTES + 1)])
def test_undecodable_request_is_refused(worker: Worker, key: Callable[[str], str], payload: bytes) -> None:
    error = worker.error(key(worker.name), payload)
    assert (error.code, error.field) == (types_pb2.ERROR_CODE_INVALID_ARGUMENT, "payload")
    worker.reset()


def test_empty_request_is_refused(worker: Worker) -> None:
    assert worker.error(keys.sim_reset(worker.name), b"").field == "variation.task"
    assert worker.error(keys.sim_step(worker.name), b"").field == "episode_id"


def test_full_queue_refuses_at_once(worker: Worker) -> None:
    request = sim_pb2.ResetRequest(variation=types_pb2.Variation(task="reach", seed=SEED)).SerializeToString()
    key = keys.sim_reset(worker.name)
    pending = [worker.session.get(key, payload=request, timeout=READY_SECONDS) for _ in range(QUEUE_LENGTH + 4)]
    replies = [reply for replies in pending for reply in replies]
    assert len(replies) == len(pending)
    codes = [decode(types_pb2.Error, reply.err.payload.to_bytes()).code for reply in replies if reply.err]
    assert codes
    assert set(codes) == {types_pb2.ERROR_CODE_RESOURCE_EXHAUSTED}
    worker.reset()


def test_watchers_see_every_applied_step(worker: Worker) -> None:
    frames = worker.session.declare_subscriber(keys.sim_frame("w0"), collect())
    actions = worker.session.declare_subscriber(keys.sim_action("w0"), collect())
    start = worker.reset()
    steps = [worker.step(start.episode_id, step, (0, 0, 1, 0)) for step in (0, 0, 1)]
    for step, state in enumerate([start, steps[0], steps[2]]):
        frame = decode(sim_pb2.Frame, wait_for_sample(frames, zenoh.SampleKind.PUT).payload.to_bytes())
        assert (frame.episode_id, frame.step) == (start.episode_id, step)
        assert (frame.image, frame.goal) == (state.observation, start.goal)
        assert (frame.success, frame.progress) == (state.success, state.progress)
        assert (frame.hand_position, frame.control) == (state.hand_position, start.control)
    for step in range(2):
        action = decode(sim_pb2.AppliedAction, wait_for_sample(actions, zenoh.SampleKind.PUT).payload.to_bytes())
        assert (action.episode_id, action.step, list(action.action.values)) == (start.episode_id, step, [0, 0, 1, 0])
    frames.undeclare()
    actions.undeclare()


def test_two_workers_never_mix_their_frames(
    session: zenoh.Session, start_worker: StartWorker, simulator: Simulator
) -> None:
    tasks = {"left": "door-lock", "right": "coffee-button"}
    for name in tasks:
        start_worker(name)
    workers = {name: Worker(session, name) for name in tasks}
    starts = {name: workers[name].reset(task) for name, task in tasks.items()}
    got = {name: [pixels(start.observation)] for name, start in starts.items()}
    for step in range(4):
        for name, worker in workers.items():
            response = worker.step(starts[name].episode_id, step, (1, 0, -1, 1))
            got[name].append(pixels(response.observation))
    for name, task in tasks.items():
        simulator.reset(task, SEED)
        for frame in got[name]:
            assert np.array_equal(frame, simulator.frame())
            simulator.step(np.array([1, 0, -1, 1], np.float32))


def test_sigterm_ends_a_worker_and_its_token(session: zenoh.Session, start_worker: StartWorker) -> None:
    process = start_worker("mortal")
    gone = session.liveliness().declare_subscriber(keys.sim_alive("mortal"), collect())
    os.kill(process.pid, signal.SIGTERM)
    wait_for_sample(gone, zenoh.SampleKind.DELETE)
    gone.undeclare()
    assert process.wait(timeout=READY_SECONDS) == 0
    with pytest.raises(UnavailableError):
        Worker(session, "mortal").reset()


def test_fault_in_a_request_is_answered_and_ends_the_episode(session: zenoh.Session, simulator: Simulator) -> None:
    # An episode without a loaded task.
    episodes = EpisodeRunner(Simulator(simulator._renderer), max_steps=1)
    episodes._episode = _Episode("x", goal=types_pb2.Image(), observation=types_pb2.Image(), hand_position=[])
    server = SimServer(session, "faulty", episodes)
    alive = session.liveliness().declare_subscriber(keys.sim_alive("faulty"), collect())
    stop = threading.Event()
    thread = threading.Thread(target=server.run, args=(stop,))
    thread.start()
    try:
        wait_for_sample(alive, zenoh.SampleKind.PUT)
        worker = Worker(session, "faulty")
        with pytest.raises(RequestError, match="INTERNAL"):
            worker.step("x", 0)
        with pytest.raises(RequestError, match="NOT_FOUND episode_id: expected an episode started by a reset"):
            worker.step("x", 0)
    finally:
        stop.set()
        thread.join()
        alive.undeclare()


def test_worker_is_found_again_after_its_router(simulator: Simulator) -> None:
    endpoint = free_endpoint()
    command = [COMMAND, "serve", "--worker", "routed", "--mode", "client", "--connect", endpoint]
    with ExitStack() as stack, subprocess.Popen(command) as process:
        stack.callback(process.terminate)
        # The worker first waits for its router, and later loses it.
        with open_session(router(endpoint)):
            session = stack.enter_context(open_session(client(endpoint)))
            wait_for(lambda: list(session.liveliness().get(keys.sim_alive("routed"), timeout=READY_SECONDS)))
            start = Worker(session, "routed").reset()
        with open_session(router(endpoint)):
            wait_for(lambda: is_connected(session))
            wait_for(lambda: list(session.liveliness().get(keys.sim_alive("routed"), timeout=READY_SECONDS)))
            response = Worker(session, "routed").step(start.episode_id, 0)
            simulator.reset("reach", SEED)
            simulator.step(np.array(REST, np.float32))
            assert np.array_equal(pixels(response.observation), simulator.frame())
            os.kill(process.pid, signal.SIGTERM)
            assert process.wait(timeout=READY_SECONDS) == 0


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_second_worker_of_a_name_is_refused(mode: str) -> None:
    endpoint = free_endpoint()
    with open_session(router(endpoint)) as routing, open_session(client(endpoint)) as session:
        token = session.liveliness().declare_token(keys.sim_alive("twin"))
        wait_for(lambda: list(routing.liveliness().get(keys.sim_alive("twin"), timeout=READY_SECONDS)))
        command = [COMMAND, "serve", "--worker", "twin", "--mode", mode, "--connect", endpoint]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        assert run.returncode == 1
        assert "worker twin runs elsewhere or has just died; waiting for it to go" in run.stderr
        assert "worker: expected a name that no running worker has, got 'twin'" in run.stderr
        assert "stop the other worker, or give this one another --worker" in run.stderr
        token.undeclare()


def test_second_worker_of_a_name_among_peers_is_refused(
    session: zenoh.Session, start_worker: StartWorker, endpoint: str
) -> None:
    start_worker("double")
    with open_session(ZenohConfig(connect=(endpoint,))) as peer, pytest.raises(NameTakenError, match="got 'double'"):
        claim_name(peer, "double", threading.Event(), patience_seconds=0)
    Worker(session, "double").reset()


def test_name_of_a_worker_that_died_is_taken_over() -> None:
    endpoint = free_endpoint()
    key = keys.sim_alive("late")
    with open_session(router(endpoint)), open_session(client(endpoint)) as late, open_session(client(endpoint)) as heir:
        stop = threading.Event()
        claim_name(heir, "late", stop)
        lingering = late.liveliness().declare_token(key)
        wait_for(lambda: list(heir.liveliness().get(key, timeout=READY_SECONDS)))
        with pytest.raises(NameTakenError, match="got 'late'"):
            claim_name(heir, "late", stop, patience_seconds=0)

        claims = threading.Thread(target=claim_name, args=(heir, "late", stop, READY_SECONDS))
        claims.start()
        lingering.undeclare()
        claims.join(READY_SECONDS)
        assert not claims.is_alive()

        stop.set()
        with pytest.raises(StoppedError):
            claim_name(heir, "late", stop)


def test_name_does_not_become_free_by_the_loss_of_the_router() -> None:
    endpoint = free_endpoint()
    stop = threading.Event()
    with ExitStack() as stack:
        with open_session(router(endpoint)):
            holder = stack.enter_context(open_session(client(endpoint)))
            heir = stack.enter_context(open_session(client(endpoint)))
            token = holder.liveliness().declare_token(keys.sim_alive("held"))
            wait_for(lambda: list(heir.liveliness().get(keys.sim_alive("held"), timeout=READY_SECONDS)))
            claims = threading.Thread(target=claim_name, args=(heir, "held", stop, READY_SECONDS))
            claims.start()
        wait_for(lambda: not is_connected(heir))
        with open_session(router(endpoint)):
            wait_for(lambda: is_connected(heir) and is_connected(holder))
            assert claims.is_alive()
            token.undeclare()
            claims.join(READY_SECONDS)
            assert not claims.is_alive()


@pytest.mark.parametrize(
    ("options", "message"),
    [({"worker": "a/b"}, "worker: expected a name"), ({"max_steps": 501}, "max_steps: expected 1 to 500, got 501")],
)
def test_invalid_configuration_is_refused(options: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ServeConfig(**options)  # pyright: ignore[reportArgumentType]


def test_every_task_allows_the_largest_step_limit() -> None:
    assert SawyerXYZEnv.max_path_length == MAX_STEPS
