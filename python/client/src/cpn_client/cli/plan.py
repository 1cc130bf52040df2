"""Command `plan`."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from tyro.conf import Positional

from cpn_client.cli.arguments import File, Number
from cpn_client.cli.chart import draw
from cpn_client.cli.connection import Connection
from cpn_client.cli.goals import read_goal
from cpn_client.cli.pictures import read, write_png
from cpn_client.cli.table import print_table
from cpn_client.errors import invalid
from cpn_client.image import Resize
from cpn_client.plan import Plan, Search
from cpn_client.recording import recorded_observation

MAX_UPDATES, MAX_DEADLINE_MS = 1000, 2**32 - 1


@dataclass(frozen=True)
class PlanActions:
    """Next actions from an observation towards a goal."""

    observation: Positional[str]
    """Camera image: image file, or recording (.mcap) for its first frame."""
    goal: Positional[str]
    """Image file, recording (.mcap) for its last frame or its trial's goal, or name or id of a registered goal."""
    model: str = "cpn"
    """Name of the model."""
    updates: Number = None
    """Number of updates of the plan by gradient descent, 0 to 1000. (default: the model's own)"""
    deadline_ms: Number = None
    """Longest wait for the plan, in milliseconds. (default: 10000)"""
    resize: Resize = "pad"
    """Treatment of images that are not square: black bars at the shorter side, or the longer one cut."""
    json: bool = False
    """JSON in place of the table."""
    draw: File = ""
    """PNG file to write, with observation, goal, and planned x, y and z over the steps."""

    def run(self, connection: Connection) -> None:
        """Prints the plan, and draws it if asked to."""
        _check("--updates", self.updates, 0, MAX_UPDATES)
        _check("--deadline-ms", self.deadline_ms, 1, MAX_DEADLINE_MS)
        observation = read(self.observation, "OBSERVATION", self.resize, recorded_observation)
        goal = read_goal(self.goal, self.resize)
        search = None if self.updates is None else Search(iterations=self.updates)
        with connection.open() as planner:
            plan = planner.plan(
                model=self.model, goal=goal, observation=observation, deadline_ms=self.deadline_ms, search=search
            )
        if self.draw:
            write_png(Path(self.draw), draw(observation, goal, plan.actions), "--draw")
        if self.json:
            print(json.dumps(asdict(plan)))
        else:
            _print(plan)


def _check(option: str, number: int | None, least: int, most: int) -> None:
    if number is not None and not least <= number <= most:
        raise invalid(option, f"{least} to {most}", number)


def _print(plan: Plan) -> None:
    names = ("x", "y", "z", "gripper", *map(str, range(5, 33)))
    header = ("step", *names[: len(plan.first_action)])
    print_table(header, [(step, *action) for step, action in enumerate(plan.actions, 1)])
    times = plan.times
    print()
    if plan.inner_losses:
        print("inner loss      ", " -> ".join(f"{loss:.4f}" for loss in plan.inner_losses))
    if plan.latent_distance is not None:
        print(f"latent distance  {plan.latent_distance:.4f}")
    stages = (("queue", times.queue_seconds), ("encode", times.encode_seconds), ("plan", times.plan_seconds))
    print("time            ", ", ".join(f"{name} {1000 * seconds:.2f} ms" for name, seconds in stages))
    print("model digest    ", plan.model_digest)
    print("goal id         ", plan.goal_id)
