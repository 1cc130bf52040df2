"""A task and a camera of one's own: demonstrations, training, and plans towards images of the finished task.

examples/.venv/bin/python examples/own_task.py
"""

import argparse
import shlex
import socket
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

import cpn_client

parser = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
parser.add_argument("--folder", type=Path, default=Path("runs/own"), help="demonstrations and checkpoint")
parser.add_argument("--programs", type=Path, default=Path("target/release"), help="folder of the programs")
parser.add_argument("--demonstrations", type=int, default=100)
parser.add_argument("--epochs", type=int, default=60)
parser.add_argument("--trials", type=int, default=20)
options = parser.parse_args()


# 1. A task: the hand, a red disc, is to be moved over the table to the place that the goal image shows.


class Reach(gymnasium.Env[NDArray[np.uint8], Any]):
    """Table seen from above, x from -1 to 1 and y from -0.75 to 0.75, with random places of start and goal.

    An observation is the camera image, uint8 [120, 160, 3]; an action is the displacement in x and y, float32 [2] in
    [-1, 1], in tenths. `info` of a reset has the goal image. An episode terminates within 0.1 of the goal.
    """

    observation_space = Box(0, 255, (120, 160, 3), np.uint8)
    action_space = Box(-1, 1, (2,), np.float32)
    corner = np.array([1, 0.75])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Starts the variation of a seed."""
        super().reset(seed=seed)
        self.hand = self.goal = self.np_random.uniform(-self.corner, self.corner)
        while np.linalg.norm(self.goal - self.hand) < 0.6:
            self.goal = self.np_random.uniform(-self.corner, self.corner)
        return self.image(self.hand), {"goal": self.image(self.goal)}

    def step(self, action: Sequence[float]) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Moves the hand."""
        self.hand = np.clip(self.hand + 0.1 * np.clip(action, -1, 1), -self.corner, self.corner)
        solved = bool(np.linalg.norm(self.goal - self.hand) < 0.1)
        return self.image(self.hand), float(solved), solved, False, {}

    def image(self, hand: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Camera image of the hand at a place."""
        y, x = np.mgrid[-0.75:0.75:120j, -1:1:160j]
        table = 90 + 20 * ((np.floor(4 * x) + np.floor(4 * y)) % 2)[..., np.newaxis]
        disc = np.clip(20 * (0.15 - np.hypot(x - hand[0], y - hand[1])), 0, 1)[..., np.newaxis]
        return (table * (1 - disc) + disc * [220, 60, 40]).astype(np.uint8)

    def expert(self) -> NDArray[np.float64]:
        """Action of the scripted expert: straight to the goal."""
        return np.clip((self.goal - self.hand) / 0.1, -1, 1)


reach = Reach()
env = TimeLimit(reach, 30)


def run(frame: NDArray[np.uint8], policy: Callable[[NDArray[np.uint8]], Any]) -> tuple[list[Any], list[Any], bool]:
    """Runs an episode from its first frame; returns T + 1 frames, T actions, and whether the task is solved."""
    frames, actions = [frame], []
    terminated = truncated = False
    while not (terminated or truncated):
        actions.append(policy(frames[-1]))
        frame, _, terminated, truncated, _ = env.step(actions[-1])
        frames.append(frame)
    return frames, actions, terminated


# 2. Demonstrations: an episode each, whose last frame is its goal image.

dataset, models = options.folder / "demonstrations", options.folder / "models"
for seed in range(options.demonstrations):
    if (dataset / f"reach/reach-{seed}.mcap").exists():
        continue
    frame, _ = env.reset(seed=seed)
    frames, actions, solved = run(frame, lambda _: reach.expert())
    cpn_client.write_episode(
        dataset, task="reach", seed=seed, frames=frames, actions=actions, control_hz=10, success=solved
    )


# 3. Training. An action has two values here; later frames of an episode are goals too, and images are shifted by up to
# 8 pixels at random, since there are few demonstrations.


def command(program: str, *arguments: str | Path) -> list[str]:
    """Command line of a program, which is printed."""
    line = [str(options.programs / program), *map(str, arguments)]
    print("$", shlex.join(line), flush=True)
    return line


subprocess.run(command("cpn-trainer", "verify", "--dataset", dataset), check=True)
settings = {
    "model.actions": 2,
    "training.epochs": options.epochs,
    "training.goals": "hindsight",
    "training.shift_pixels": 8,
}
changes = [text for key, value in settings.items() for text in ("--set", f"{key}={value}")]
files = "--dataset", dataset, "--out", models / "reach.safetensors", "--run-dir", options.folder / "training"
subprocess.run(command("cpn-trainer", "train", "--preset", "cpn", *files, *changes), check=True)


# 4. Plans, towards goal images of variations without a demonstration.

seeds = range(1_000_000, 1_000_000 + options.trials)
env.action_space.seed(0)
by_chance = sum(run(env.reset(seed=seed)[0], lambda _: env.action_space.sample())[2] for seed in seeds)
planned = 0
with socket.create_server(("127.0.0.1", 0)) as free:
    address = f"tcp/127.0.0.1:{free.getsockname()[1]}"
listen = "--listen", address, "--grpc-listen", "127.0.0.1:0"
with subprocess.Popen(command("cpn-planner", "--models-dir", models, *listen)) as server:
    try:
        with cpn_client.connect(address) as planner:
            for seed in seeds:
                frame, info = env.reset(seed=seed)
                with planner.episode(info["goal"], model="reach") as episode:
                    planned += run(frame, episode.act)[2]
    finally:
        server.terminate()
print(f"solved: {planned} of {len(seeds)} with plans, {by_chance} of {len(seeds)} with random actions")
