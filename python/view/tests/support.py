import json
import random
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import zenoh
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from mcap_protobuf.writer import Writer
from numpy.typing import NDArray

from cpn.v1 import demonstration_pb2, planner_pb2, sim_pb2, trial_pb2, types_pb2

SIZE = 84
WAIT_SECONDS = 60.0


def free_port(count: int = 1) -> int:
    """First of `count` free ports in a row, below the ephemeral ports of the system."""
    while True:
        port = random.randrange(20_000, 32_000)  # noqa: S311
        try:
            for offset in range(count):
                socket.create_server(("127.0.0.1", port + offset)).close()
        except OSError:
            continue
        return port


def wait_for(condition: Callable[[], object]) -> None:
    """Waits until the condition holds."""
    end = time.monotonic() + WAIT_SECONDS
    while not condition():
        assert time.monotonic() < end, "the condition does not come true"
        time.sleep(0.01)


@contextmanager
def listen(endpoint: str) -> Iterator[zenoh.Session]:
    """Peer that listens at the endpoint."""
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        yield session


@dataclass(frozen=True)
class Network:
    """Network of a peer that stands in for workers: it publishes what they do."""

    endpoint: str
    session: zenoh.Session

    def alive(self, worker: str) -> zenoh.LivelinessToken:
        return self.session.liveliness().declare_token(f"cpn/@v1/alive/sim/{worker}")

    def frame(
        self,
        worker: str,
        step: int,
        frame: NDArray[np.uint8],
        episode: str = "reach-0-ab",
        **fields: Any,  # noqa: ANN401
    ) -> None:
        message = sim_pb2.Frame(episode_id=episode, step=step, image=image(frame), **fields)
        self.session.put(f"cpn/@v1/sim/{worker}/frame", message.SerializeToString())

    def plan(self, worker: str, step: int, plan: planner_pb2.PlanResponse, episode: str = "reach-0-ab") -> None:
        message = sim_pb2.TrialPlan(episode_id=episode, step=step, model="cpn", plan=plan)
        self.session.put(f"cpn/@v1/sim/{worker}/plan", message.SerializeToString())

    def action(self, worker: str, step: int, values: NDArray[np.float32], episode: str = "reach-0-ab") -> None:
        message = sim_pb2.AppliedAction(episode_id=episode, step=step, action=action(values))
        self.session.put(f"cpn/@v1/sim/{worker}/action", message.SerializeToString())


def image(frame: NDArray[np.uint8]) -> types_pb2.Image:
    height, width, _ = frame.shape
    pixel_format = types_pb2.PIXEL_FORMAT_RGB8
    return types_pb2.Image(height=height, width=width, format=pixel_format, data=frame.tobytes())


def action(values: NDArray[np.float32]) -> types_pb2.Action:
    return types_pb2.Action(values=values.tolist())


def frames(count: int, seed: int = 0) -> NDArray[np.uint8]:
    """Random frames, [count, height, width, 3]."""
    return np.random.default_rng(seed).integers(0, 256, (count, SIZE, SIZE, 3), np.uint8)


def actions(*shape: int) -> NDArray[np.float32]:
    """Random actions in [-1, 1]."""
    return np.random.default_rng(1).uniform(-1, 1, shape).astype(np.float32)


ROW = "rerun.controls.RowId"


def blueprints(path: Path) -> int:
    """Number of blueprints in a file."""
    return len(rr.chunk.RrdReader(path).blueprints())


def batches(path: Path, entity: str) -> Iterator[pa.RecordBatch]:
    """Rows of an entity, in all recordings of a file."""
    reader = rr.chunk.RrdReader(path)
    for store in reader.recordings():
        for chunk in reader.stream(store=store):
            if chunk.entity_path == entity:
                yield chunk.to_record_batch()


def rows(path: Path, entity: str) -> list[dict[str, Any]]:
    """Components of each row of an entity, by name, in the order of logging."""
    found: list[dict[str, Any]] = []
    for batch in batches(path, entity):
        components = [name for name in batch.schema.names if ":" in name]
        found += batch.select([ROW, *components]).to_pylist()
    found.sort(key=lambda row: row[ROW])
    return [{name: value for name, value in row.items() if value is not None} for row in found]


def column(path: Path, entity: str, component: str) -> list[Any]:
    """Values of a component of an entity, in the order in which they were logged."""
    return [row[component] for row in rows(path, entity) if component in row]


def times(path: Path, entity: str, timeline: str) -> list[int]:
    """Times of an entity, in nanoseconds or as a sequence, sorted."""
    columns = [batch.column(timeline) for batch in batches(path, entity) if timeline in batch.schema.names]
    return sorted(value for values in columns for value in values.cast("int64").to_pylist())


def pictures(path: Path, entity: str) -> list[NDArray[np.uint8]]:
    """Images of an entity, each [84, 84, 3]."""
    return [np.array(buffer, np.uint8).reshape(SIZE, SIZE, 3) for (buffer,) in column(path, entity, "Image:buffer")]


def scalars(path: Path, entity: str) -> NDArray[np.float64]:
    """Scalars of an entity, [rows, values]."""
    return np.array(column(path, entity, "Scalars:scalars"))


def texts(path: Path, entity: str) -> list[str]:
    """Text documents of an entity."""
    return [text for (text,) in column(path, entity, "TextDocument:text")]


class Recording:
    """MCAP file under construction."""

    def __init__(self, path: Path, header: Message) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("wb")
        self._writer = Writer(self._file)
        self.write("/episode", header, 0, 0)

    def write(self, topic: str, message: Message, step: int, time: int) -> None:
        self._writer.write_message(topic, message, log_time=time, publish_time=time, sequence=step)

    def frame(self, frame: NDArray[np.uint8], step: int, time: int, encoding: str = "rgb8") -> None:
        height, width, _ = frame.shape
        raw = RawImage(width=width, height=height, encoding=encoding, step=width * 3, data=frame.tobytes())
        self.write("/camera", raw, step, time)

    def close(self) -> None:
        self._writer.finish()
        self._file.close()


def demonstration(path: Path, count: int = 6) -> Path:
    """Demonstration with random frames and actions, at 80 Hz."""
    variation = {"task": "reach", "seed": 3}
    header = demonstration_pb2.RecordedEpisode(variation=variation, steps=count, control_hz=80)
    recording = Recording(path, header)
    for t in range(count):
        time = t * 12_500_000
        recording.frame(frames(count)[t], t, time)
        step = demonstration_pb2.RecordedStep(step=t, reward=t / 2, success=t >= count - 2)
        if t < count - 1:
            step.action.CopyFrom(action(actions(count, 4)[t]))
        recording.write("/step", step, t, time)
    recording.close()
    return path


def trial(path: Path, count: int = 5, horizon: int = 3) -> Path:
    """Trial with a plan for each frame but the last."""
    header = trial_pb2.RecordedTrial(
        variation={"task": "reach", "seed": 1_000_000},
        model="cpn",
        goal=image(frames(1, 9)[0]),
        steps=count,
        plans=count,
    )
    recording = Recording(path, header)
    for t in range(count + 1):
        recording.frame(frames(count + 1)[t], t, 20_000_000 * t)
        if t < count:
            recording.write("/plan/request", planner_pb2.PlanRequest(model="cpn", goal_id="0"), t, 20_000_000 * t + 1)
            recording.write("/plan/response", plan(t, horizon), t, 20_000_000 * t + 5_000_000)
    recording.close()
    return path


def plan(t: int, horizon: int) -> planner_pb2.PlanResponse:
    """Plan of step t, of two updates."""
    planned = actions(5, horizon, 4)[t]
    return planner_pb2.PlanResponse(
        actions=[action(values) for values in planned],
        first_action=action(planned[0]),
        inner_losses=[t + 3.0, t + 2.0, t + 1.0],
        latent_distance=0.5 * t,
        times={"queue_seconds": 0.001, "encode_seconds": 0.002, "plan_seconds": 0.003},
    )
