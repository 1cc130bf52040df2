"""Executes plans and baselines in the simulated arm, each on the same variations.

Controllers: trajectories planned before the hand moves, by CPN, by CPN trained with goals in hindsight, by CPN with
position dynamics, and by the policy of the latter, without updates; CPN planning anew at every step, with position
dynamics and without; the recorded actions of the nearest demonstration; a straight line of the fingertip, by inverse
kinematics. Models are named `cpn-<seed>`, `hindsight-<seed>` and `position-<seed>`.

Each trial is a line of `trials.jsonl` as soon as it is done; a second run executes the missing ones.
"""

import json
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import zenoh
from planning import Array, Demonstration, Planner, along, demonstrations, network, request

from cpn.v1 import sim_pb2, types_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.jenga import ACTION_METRES
from cpn_sim_worker.session import UnavailableError
from cpn_sim_worker.tasks import FIRST_EVALUATION_SEED

VARIATIONS = {"jenga-poke": 21, "jenga-poke-offset": 24}
"""Seven fresh starts for each of the three trained targets, four for each of the six that are offset in height."""
REST_STEPS = 3
"""The hand trails its set point: so long it rests at the end."""

Move = Callable[[Array, Array], Iterator[Array]]
"""From start and goal, [3] in metres, to actions, [3]; is sent the hand's position after each."""


@dataclass(frozen=True)
class Trial:
    """An episode of a controller on one variation."""

    method: str
    model: str
    """Name of the checkpoint, for CPN."""
    task: str
    seed: int
    goal: list[float]
    planned: list[list[float]]
    """Positions that were predicted beforehand, in metres; empty if the plan was made on the way."""
    executed: list[list[float]]
    """The fingertip from its start to its end, in metres."""
    success: bool
    """Whether the block was poked, and nothing else moved."""


@dataclass(frozen=True)
class Controller:
    """A controller and its name."""

    method: str
    model: str
    actions: Callable[[Array, Array], Array] | None
    """All actions from start and goal; none for a model that plans at every step."""


def straight(start: Array, goal: Array) -> Array:
    """A line to the goal in as few equal steps as the arm allows."""
    steps = int(np.ceil(np.abs(goal - start).max() / ACTION_METRES))
    return np.tile((goal - start) / (steps * ACTION_METRES), (steps, 1))


def nearest(recorded: list[Demonstration]) -> Callable[[Array, Array], Array]:
    """The actions of the demonstration whose start and goal, taken as one vector of six, are nearest."""

    def distance(demonstration: Demonstration, start: Array, goal: Array) -> float:
        return float(np.linalg.norm([demonstration.positions[0] - start, demonstration.goal - goal]))

    return lambda start, goal: min(recorded, key=lambda d: distance(d, start, goal)).actions


def run(
    session: zenoh.Session, worker: str, planner: Planner, controller: Controller, task: str, seed: int, length: int
) -> Trial:
    """Moves until the block is poked, or for `length` steps and a rest."""
    variation = types_pb2.Variation(task=task, seed=seed)
    reset = sim_pb2.ResetRequest(variation=variation)
    start = request(session, keys.sim_reset(worker), reset, sim_pb2.ResetResponse)
    hand, goal = np.array(start.hand_position, np.float64), np.array(start.goal_position, np.float64)
    planned = None if controller.actions is None else controller.actions(hand, goal)
    executed, success = [hand.tolist()], False
    for step in range(length + REST_STEPS):
        action = np.zeros(3)
        if planned is None:
            if step < length:
                action = planner.plan(controller.model, hand, goal)[0]
        elif step < len(planned):
            action = planned[step]
        message = sim_pb2.StepRequest(
            episode_id=start.episode_id, step=step, action=types_pb2.Action(values=action.tolist())
        )
        response = request(session, keys.sim_step(worker), message, sim_pb2.StepResponse)
        hand, success = np.array(response.hand_position, np.float64), response.success
        executed.append(hand.tolist())
        if response.done:
            break
    predicted = [] if planned is None else along(np.array(executed[0]), planned).tolist()
    return Trial(controller.method, controller.model, task, seed, goal.tolist(), predicted, executed, success)


def done(path: Path) -> set[tuple[str, str, str, int]]:
    """The trials of an earlier run; a line that was cut off is removed."""
    text = path.read_text() if path.exists() else ""
    path.write_text(text := text[: text.rfind("\n") + 1])
    trials = map(json.loads, text.splitlines())
    return {(trial["method"], trial["model"], trial["task"], trial["seed"]) for trial in trials}


def execute(
    endpoint: str, planner_name: str, folder: Path, episodes: list[str], workers: list[str], models: list[str]
) -> None:
    """Shares the trials between the workers, and writes them and the demonstrations to the folder."""
    alive = [keys.planner_alive(planner_name), *map(keys.sim_alive, workers)]
    with network(endpoint, *alive) as session:
        recorded = demonstrations(session, episodes)
        (folder / "demonstrations.json").write_text(json.dumps([d.positions.tolist() for d in recorded]) + "\n")
        planner, length = Planner(session, planner_name), max(len(d.actions) for d in recorded)
        controllers = [Controller("line", "", straight), Controller("nearest", "", nearest(recorded))]
        for model in models:
            method = model.split("-")[0]
            controllers.append(
                Controller(method, model, lambda s, g, model=model: planner.trajectory(model, s, g, length))
            )
            if method != "hindsight":
                controllers.append(Controller(f"{method}-mpc", model, None))
            if method == "position":
                controllers.append(
                    Controller("policy", model, lambda s, g, model=model: planner.trajectory(model, s, g, length, 0))
                )
        path = folder / "trials.jsonl"
        earlier = done(path)
        jobs = [
            (controller, task, seed)
            for task, n in VARIATIONS.items()
            for seed in range(FIRST_EVALUATION_SEED, FIRST_EVALUATION_SEED + n)
            for controller in controllers
            if (controller.method, controller.model, task, seed) not in earlier
        ]
        writing = threading.Lock()

        def share(number: int) -> int:
            """Makes the trials of a worker; answers how many it could not."""
            failed = 0
            for job in jobs[number :: len(workers)]:
                try:
                    trial = run(session, workers[number], planner, *job, length)
                except UnavailableError as error:
                    failed += 1
                    print(f"{job}: {error}", file=sys.stderr)
                    continue
                with writing, path.open("a") as file:
                    file.write(json.dumps(asdict(trial)) + "\n")
            return failed

        with ThreadPoolExecutor(len(workers)) as pool:
            failed = sum(pool.map(share, range(len(workers))))
    if failed:
        raise SystemExit(f"{failed} of {len(jobs)} trials failed; a second run makes them")
