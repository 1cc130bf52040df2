import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap_protobuf.writer import Writer
from numpy.typing import NDArray

from cpn.v1 import demonstration_pb2

SIZE, STATE_SIZE, ACTION_SIZE = 84, 39, 4


@dataclass
class Sample:
    """Recording with random contents, which can be changed before it is written."""

    task: str
    seed: int
    length: int = 5
    control_hz: float = 80.0
    render_spec: str = '{"camera":"corner4"}'
    state_size: int = STATE_SIZE
    steps: int | None = None
    digest: str | None = None
    step_hz: float | None = None
    """Control rate of the steps' times, if not `control_hz`."""
    action_scale: float = 1.0
    last_action: bool = False
    """Whether the goal frame has an action, which is a fault."""
    goal_position: tuple[float, ...] = (0.5, 0.25, 0.125)
    frames: NDArray[np.uint8] = field(init=False)
    actions: NDArray[np.float32] = field(init=False)
    states: NDArray[np.float32] = field(init=False)
    rewards: NDArray[np.float32] = field(init=False)
    successes: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        random = np.random.default_rng([self.seed, *self.task.encode()])
        count = self.length + 1
        self.frames = random.integers(0, 256, (count, SIZE, SIZE, 3), np.uint8)
        self.actions = random.uniform(-1, 1, (self.length, ACTION_SIZE)).astype(np.float32) * self.action_scale
        self.states = random.normal(size=(count, self.state_size)).astype(np.float32)
        self.rewards = random.uniform(0, 10, count).astype(np.float32)
        self.rewards[0] = 0
        self.successes = np.arange(count) >= count - 2

    @property
    def episode_id(self) -> str:
        return f"{self.task}-{self.seed}"

    def write(self, dataset: Path, place: str | None = None) -> Path:
        """Writes the recording to its own path, or to another one."""
        path = dataset / (place or f"{self.task}/{self.episode_id}.mcap")
        path.parent.mkdir(parents=True, exist_ok=True)
        none = np.empty(0, np.float32)
        actions = [*self.actions, np.ones(ACTION_SIZE, np.float32) if self.last_action else none]
        applied = [-action if t % 2 else none for t, action in enumerate(actions)]  # Noise at every second step.
        digest = hashlib.sha256()
        for t, action in enumerate(actions):
            for part in (self.frames[t], action, applied[t], self.states[t], self.rewards[t], self.successes[t]):
                digest.update(part.tobytes())
        header = demonstration_pb2.RecordedEpisode(
            episode_id=self.episode_id,
            variation={"task": self.task, "seed": self.seed},
            render_spec=self.render_spec,
            goal_position=self.goal_position,
            steps=len(actions) if self.steps is None else self.steps,
            digest=self.digest or digest.hexdigest(),
            control_hz=self.control_hz,
        )
        with path.open("wb") as file, Writer(file) as writer:
            writer.write_message("/episode", header, log_time=0, publish_time=0)
            for t, action in enumerate(actions):
                time = round(t * 1e9 / (self.step_hz or self.control_hz))
                frame = RawImage(
                    frame_id="camera",
                    width=SIZE,
                    height=SIZE,
                    encoding="rgb8",
                    step=SIZE * 3,
                    data=self.frames[t].tobytes(),
                )
                frame.timestamp.FromNanoseconds(time)
                step = demonstration_pb2.RecordedStep(
                    step=t,
                    action={"values": action} if len(action) else None,
                    applied_action={"values": applied[t]} if len(applied[t]) else None,
                    state=self.states[t],
                    reward=self.rewards[t],
                    success=self.successes[t],
                )
                writer.write_message("/camera", frame, log_time=time, publish_time=time)
                writer.write_message("/step", step, log_time=time, publish_time=time)
        return path
