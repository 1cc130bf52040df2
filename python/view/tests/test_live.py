import json
import logging
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import psutil
import pytest
import rerun as rr
import zenoh
from google.protobuf.message import Message

from cpn.v1 import planner_pb2, sim_pb2, types_pb2
from cpn_view.live import ACTIONS, ALIVE, FRAMES, PLANS, QUEUE_LENGTH, LiveView
from cpn_view.viewer import ViewerConfig, serve
from tests.support import (
    WAIT_SECONDS,
    Network,
    action,
    actions,
    blueprints,
    column,
    frames,
    free_port,
    image,
    pictures,
    rows,
    scalars,
    texts,
    wait_for,
)

ROOT = Path(__file__).parents[3]
WORKER = os.environ.get("CPN_SIM_WORKER", ROOT / "sim-worker/.venv/bin/cpn-sim-worker")
MIB = 1 << 20

M = TypeVar("M", bound=Message)

# A file that is still written to has no footer.
pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")


@pytest.fixture
def stream(rrd: Path) -> Iterator[rr.RecordingStream]:
    """Stream into the file."""
    stream = rr.RecordingStream("cpn-view-test")
    stream.save(rrd)
    yield stream
    stream.disconnect()


@pytest.fixture
def view(watcher: zenoh.Session, stream: rr.RecordingStream) -> LiveView:
    return LiveView(watcher, stream)


Shown = Callable[[Callable[[], object]], None]


@pytest.fixture
def shown(view: LiveView, stream: rr.RecordingStream) -> Shown:
    """Function that polls the view until the condition holds for the file."""

    def wait(condition: Callable[[], object]) -> None:
        def polled() -> object:
            view.poll()
            stream.flush()
            return condition()

        wait_for(polled)

    return wait


def frame_of(**image: Any) -> sim_pb2.Frame:  # noqa: ANN401
    return sim_pb2.Frame(image=types_pb2.Image(**image))


def test_keys() -> None:
    golden = json.loads((ROOT / "tests/golden/keys.json").read_text())
    for name, key in {"sim_frame": FRAMES, "sim_action": ACTIONS, "sim_plan": PLANS, "sim_alive": ALIVE}.items():
        assert golden[name]["key"] == key.replace("*", "w0")


def test_two_workers(network: Network, shown: Shown, rrd: Path) -> None:
    values = actions(4, 4)
    for step in range(4):
        for worker, seed in (("w0", 0), ("w1", 1)):
            if step:
                network.action(worker, step - 1, values[step - 1])
            network.frame(worker, step, frames(4, seed)[step])
        shown(lambda: len(pictures(rrd, "/workers/w0/camera")) == len(pictures(rrd, "/workers/w1/camera")) == step + 1)  # noqa: B023
    for worker, seed in (("w0", 0), ("w1", 1)):
        np.testing.assert_array_equal(pictures(rrd, f"/workers/{worker}/camera"), frames(4, seed))
        np.testing.assert_array_equal(scalars(rrd, f"/workers/{worker}/action"), values[:3])
        assert [text.splitlines()[0] for text in texts(rrd, f"/workers/{worker}/episode")] == [
            f"reach-0-ab, step {step}" for step in range(4)
        ]
    assert blueprints(rrd) <= 3, "a blueprint without workers, and one for each that came"


def test_gap_between_episodes(network: Network, shown: Shown, rrd: Path) -> None:
    for episode in ("a", "b"):
        for step in range(2):
            network.action("w0", step, actions(4), episode)
    shown(lambda: len(scalars(rrd, "/workers/w0/action")) == 4)
    assert ["Clear:is_recursive" in row for row in rows(rrd, "/workers/w0/action")] == [
        True,
        False,
        False,
        True,
        False,
        False,
    ]


def test_goals_and_solved_episodes(network: Network, shown: Shown, rrd: Path) -> None:
    goals = frames(2, 7)
    for number, episode in enumerate(("a", "b")):
        for step in range(3):
            fields = {"goal": image(goals[number]), "success": episode == "a" and step == 2, "progress": step / 4}
            network.frame("w0", step, frames(1)[0], episode, **fields)
            shown(lambda: len(texts(rrd, "/workers/w0/episode")) == 3 * number + step + 1)  # noqa: B023
    np.testing.assert_array_equal(pictures(rrd, "/workers/w0/goal"), goals)
    np.testing.assert_allclose(scalars(rrd, "/workers/w0/progress")[:, 0], [0, 0.25, 0.5] * 2)
    assert texts(rrd, "/workers/w0/episode")[1::2] == [
        "a, step 1\nprogress 0.25\n0 of 1 episodes solved so far",
        "b, step 0\nprogress 0.00\n1 of 2 episodes solved so far",
        "b, step 2\nprogress 0.50\n1 of 2 episodes solved so far",
    ]
    assert texts(rrd, "/workers/w0/episode")[2] == "a, step 2\nsolved\n1 of 1 episodes solved so far"


def test_plans(network: Network, shown: Shown, rrd: Path) -> None:
    camera = {"position": [0, 0, 1], "rotation": np.eye(3).ravel().tolist(), "field_of_view_degrees": 60}
    control = {"action_size": 4, "metres": 0.5, "hz": 10}
    network.frame("w0", 0, frames(1)[0], control=control, camera=camera, hand_position=[0.25, 0, 0])
    shown(lambda: pictures(rrd, "/workers/w0/camera"))

    planned = planner_pb2.PlanResponse(
        actions=[action(np.array(values, np.float32)) for values in ([1, 0, 0, 1], [2, -0.5, 0, 1])],
        inner_losses=[3, 2, 1],
        latent_distance=0.5,
        times={"queue_seconds": 0.001, "encode_seconds": 0.002, "plan_seconds": 0.003},
    )
    # Of another episode than the frame: without a path.
    network.plan("w0", 9, planned, "reach-1-cd")
    network.plan("w0", 0, planned)
    shown(lambda: len(scalars(rrd, "/workers/w0/plan/times_ms")) == 2)
    np.testing.assert_allclose(scalars(rrd, "/workers/w0/plan/times_ms")[0], [1, 2, 3])
    np.testing.assert_allclose(scalars(rrd, "/workers/w0/plan/latent_distance")[0], [0.5])
    np.testing.assert_allclose(scalars(rrd, "/workers/w0/plan/inner_loss")[0], [3, 1])
    ((strip,),) = column(rrd, "/workers/w0/path", "LineStrips3D:strips")
    np.testing.assert_allclose(np.reshape(strip, (3, 3)), [[0.25, 0, 0], [0.75, 0, 0], [1.25, -0.25, 0]])


@pytest.mark.parametrize(
    "fields",
    [
        {"camera": {"position": [0, 0], "rotation": [1] * 9, "field_of_view_degrees": 60}},
        {"camera": {"position": [0, 0, 0], "rotation": [1] * 8, "field_of_view_degrees": 60}},
        {"camera": {"position": [0, 0, 0], "rotation": [1] * 9, "field_of_view_degrees": 0}},
        {"camera": {"position": [0, 0, 0], "rotation": [1] * 9, "field_of_view_degrees": 60}, "hand_position": [0, 0]},
        {
            "camera": {"position": [0] * 3, "rotation": [1] * 9, "field_of_view_degrees": 5e-324},
            "hand_position": [0] * 3,
        },
        {"goal": types_pb2.Image(height=2, width=2)},
    ],
)
def test_faulty_frame_is_dropped(
    network: Network, shown: Shown, rrd: Path, caplog: pytest.LogCaptureFixture, fields: dict[str, Any]
) -> None:
    network.frame("w0", 0, frames(1)[0], **fields)
    shown(lambda: "dropped a message at cpn/@v1/sim/w0/frame: " in caplog.text)
    network.frame("w0", 1, frames(1)[0])
    shown(lambda: len(pictures(rrd, "/workers/w0/camera")) == 1)


@pytest.mark.parametrize("lengths", [(), (3, 1), (2,)])
def test_faulty_plan_is_dropped(
    network: Network, shown: Shown, rrd: Path, caplog: pytest.LogCaptureFixture, lengths: tuple[int, ...]
) -> None:
    network.frame("w0", 0, frames(1)[0])
    shown(lambda: pictures(rrd, "/workers/w0/camera"))
    faulty = planner_pb2.PlanResponse(actions=[action(np.zeros(length, np.float32)) for length in lengths])
    network.plan("w0", 0, faulty)
    shown(lambda: "dropped a message at cpn/@v1/sim/w0/plan: " in caplog.text)
    assert not rows(rrd, "/workers/w0/plan/times_ms")


def test_late_plan_revives_no_worker(
    network: Network, watcher: zenoh.Session, shown: Shown, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    token = network.alive("w0")
    shown(lambda: "worker w0 is here" in caplog.text)
    token.undeclare()
    shown(lambda: "worker w0 is gone" in caplog.text)
    with watcher.declare_subscriber("cpn/@v1/sim/w0/plan") as arrivals:
        network.plan("w0", 0, planner_pb2.PlanResponse())
        arrivals.recv()
    network.frame("w1", 0, frames(1)[0])
    shown(lambda: "worker w1 is here" in caplog.text)
    assert caplog.text.count("worker w0 is here") == 1


def test_slow_view_shows_the_present(network: Network, watcher: zenoh.Session, shown: Shown, rrd: Path) -> None:
    last = 10 * QUEUE_LENGTH
    with watcher.declare_subscriber("cpn/@v1/sim/w0/frame") as arrivals:
        for step in range(last + 1):
            network.action("w0", step, np.array([step], np.float32))
            network.frame("w0", step, frames(1)[0])
            arrivals.recv()
    shown(lambda: texts(rrd, "/workers/w0/episode"))
    (text,) = texts(rrd, "/workers/w0/episode")
    assert text.startswith(f"reach-0-ab, step {last}\n")
    np.testing.assert_array_equal(scalars(rrd, "/workers/w0/action")[:, 0], range(last - QUEUE_LENGTH + 1, last + 1))


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (types_pb2.Action(values=[1]), "dropped a message at cpn/@v1/sim/w0/frame: "),
        (frame_of(height=2, width=2, format="PIXEL_FORMAT_RGB8", data=b"123"), "expected 2 x 2 x 3 bytes, got 3"),
        (frame_of(height=0, width=0), "image.format: expected RGB8, got 0"),
    ],
)
def test_faulty_message(
    network: Network, shown: Shown, rrd: Path, caplog: pytest.LogCaptureFixture, message: Message, reason: str
) -> None:
    network.session.put("cpn/@v1/sim/w0/frame", message.SerializeToString())
    shown(lambda: reason in caplog.text)
    network.frame("w0", 0, frames(1)[0])
    shown(lambda: len(pictures(rrd, "/workers/w0/camera")) == 1)


def test_workers_come_and_go(network: Network, shown: Shown, rrd: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    token = network.alive("w0")
    shown(lambda: blueprints(rrd) == 2)

    token.undeclare()
    shown(lambda: texts(rrd, "/workers/w0/episode") == ["The worker is gone."])
    network.alive("w0")
    shown(lambda: caplog.text.count("worker w0 is here") == 2)
    assert blueprints(rrd) == 2, "a restarted worker keeps its panel"

    network.alive("w1")
    shown(lambda: blueprints(rrd) == 3)


def test_simulator_worker(network: Network, shown: Shown, rrd: Path) -> None:
    command = [str(WORKER), "serve", "--worker", "real", "--connect", network.endpoint]
    with subprocess.Popen(command) as process:
        try:
            shown(lambda: blueprints(rrd) == 2)
            request = sim_pb2.ResetRequest(variation={"task": "reach", "seed": 0})
            reset = ask(network, "reset", request, sim_pb2.ResetResponse)
            images = [reset.observation.data]
            for step, values in enumerate(actions(5, 4)):
                shown(lambda: len(pictures(rrd, "/workers/real/camera")) == step + 1)  # noqa: B023
                request = sim_pb2.StepRequest(episode_id=reset.episode_id, step=step, action=action(values))
                images.append(ask(network, "step", request, sim_pb2.StepResponse).observation.data)
            shown(lambda: len(pictures(rrd, "/workers/real/camera")) == 6)
        finally:
            process.terminate()
    assert [picture.tobytes() for picture in pictures(rrd, "/workers/real/camera")] == images
    np.testing.assert_array_equal(scalars(rrd, "/workers/real/action"), actions(5, 4))
    assert texts(rrd, "/workers/real/episode")[-1].startswith(f"{reset.episode_id}, step 5\n")
    assert [picture.tobytes() for picture in pictures(rrd, "/workers/real/goal")] == [reset.goal.data]
    ((resolution,),) = column(rrd, "/workers/real/camera", "Pinhole:resolution")
    assert list(resolution) == [84, 84]


def ask(network: Network, method: str, request: Message, response_type: type[M]) -> M:
    (reply,) = network.session.get(
        f"cpn/@v1/sim/real/{method}", payload=request.SerializeToString(), timeout=WAIT_SECONDS
    )
    assert reply.ok, reply.err and reply.err.payload.to_string()
    response = response_type()
    response.ParseFromString(reply.ok.payload.to_bytes())
    return response


def test_memory_is_bounded(network: Network, watcher: zenoh.Session) -> None:
    config = ViewerConfig(port=free_port(2), memory_limit_mib=16)
    with serve(config) as viewer, viewer.stream("cpn-view-test", "memory") as stream:
        view = LiveView(watcher, stream)
        images = frames(50)
        processes = psutil.Process(), psutil.Process(viewer.process.pid)

        def push(count: int) -> int:
            """Shows frames, each different; returns the resident memory of both processes, in bytes."""
            for number in range(count):
                images[number % 50] += 1
                with watcher.declare_subscriber("cpn/@v1/sim/w0/frame") as arrivals:
                    network.frame("w0", number, images[number % 50])
                    arrivals.recv()
                view.poll()
            stream.flush()
            return sum(process.memory_info().rss for process in processes)

        warm = push(2000)
        # 10,000 frames are 200 MiB. Half of that is room for what a busy machine has not yet sent.
        assert push(10_000) < warm + 100 * MIB
