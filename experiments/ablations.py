"""The paper's methods, and ablations of losses, dynamics and noise injection, on tasks left out of training by sixes.

Recipes are chosen by the development tasks; the arms in `REPORTED_ARMS` are then run on the 18 others. Interrupted, it
goes on. Each run's outcomes are kept in docs/results/ablations, of which --table makes the tables.
"""

import argparse
import json
import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

from dataset import DATASET, record
from lab import ROOT, Lab, main, train
from outcome_tables import Columns, count, differences, task_table

RESULTS = ROOT / "docs/results/ablations"
DEVELOPMENT = ("coffee-button", "dial-turn", "door-lock", "drawer-close", "handle-press", "handle-pull")
"""The four tasks that the paper names, and two that `random.Random(0)` drew of the 20 others, in the order of names."""
TRAINED = ("plate-slide", "window-close")
"""Two tasks in training while the development tasks are left out, evaluated on other variations."""
REPORTED = {
    "reported-1": ("assembly", "basketball", "button-press", "button-press-topdown", "coffee-pull", "disassemble"),
    "reported-2": ("door-close", "door-open", "door-unlock", "drawer-open", "faucet-close", "faucet-open"),
    "reported-3": ("lever-pull", "peg-insert-side", "plate-slide", "reach", "window-close", "window-open"),
}
"""The 18 other tasks by name, in groups that are left out at once."""
GROUPS = {"development": DEVELOPMENT} | REPORTED

SETTINGS = {"training.epochs": 3, "training.samples_per_draw": 8, "training.precision": "bfloat16"}
EVERY_UPDATE = {"training.losses.every_update": "true"}
DYNAMICS = {"training.losses.dynamics": 0.5}
POSITION = {"training.losses.position": 0.3}
NOISY, NOISE, NOISY_EPISODES = ROOT / "data/demonstrations-noise", 0.3, 50
"""Demonstrations with noise injection."""
NOISY_EPOCHS = {"training.epochs": 6}
"""As many updates of the weights as with twice the episodes and half the epochs."""
AUGMENTED = {"training.goals": "hindsight", "training.shift_pixels": 4}
POSITION_DYNAMICS = {"model.position_dynamics": "true", "model.updates": 5} | DYNAMICS | POSITION
ACCURATE = {"training.losses.position": 30}
"""Weight of the position loss by which positions in images of the development tasks are most accurate."""

DEFAULT = "default"
"""Number of updates that the planner chooses, straight towards the goal."""
APPROACHES = "approaches"
"""The same, with approaches: no option."""
CONTROLS = ("random", "no-op", "oracle")
"""Controls of the evaluator, and the planner's random actions."""


@dataclass(frozen=True)
class Arm:
    """Recipe of an arm."""

    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of training beside `SETTINGS`."""
    method: str = "cpn"
    noise: float = 0
    """Noise injection of the demonstrations."""
    evaluation: tuple[str, ...] = ()
    """Further options of the evaluation."""
    updates: tuple[int | str, ...] = (0, 1, 5)
    """Numbers of updates to plan with, of a method that plans; `DEFAULT` and `APPROACHES` for the planner's choice."""

    @property
    def dataset(self) -> Path:
        """Folder of the demonstrations."""
        return NOISY if self.noise else DATASET

    @property
    def is_trained(self) -> bool:
        """False for a control."""
        return self.method not in CONTROLS

    @property
    def plans(self) -> bool:
        """Whether the method plans, with a number of updates."""
        return self.method in {"upn", "cpn"}


ARMS = {
    "paper": Arm(),
    "every-update": Arm(EVERY_UPDATE),
    "every-update-dynamics": Arm(EVERY_UPDATE | DYNAMICS),
    "every-update-dynamics-position": Arm(EVERY_UPDATE | DYNAMICS | POSITION),
    "bc": Arm(method="bc"),
    "te-bc": Arm(method="te-bc"),
    # The steps left are counted down from about the mean length of a demonstration over all tasks.
    "te-bc-horizon": Arm(method="te-bc-horizon", evaluation=("--task-steps", "70")),
    "upn": Arm(method="upn", updates=(1,)),
    "position-te-bc": Arm(POSITION, "te-bc"),
    "position-dynamics": Arm(POSITION_DYNAMICS, updates=(0, 1, 2, 5, 20)),
    "accurate-position-dynamics": Arm(POSITION_DYNAMICS | ACCURATE, updates=(0, 1, 2, 5, 20)),
    "familiar-goals": Arm(POSITION_DYNAMICS | ACCURATE | {"model.familiar_goals": 1024}, updates=(DEFAULT, APPROACHES)),
    "noise-te-bc": Arm(NOISY_EPOCHS, "te-bc", NOISE),
    "noise-augmented-te-bc": Arm(NOISY_EPOCHS | AUGMENTED, "te-bc", NOISE),
    "noise-paper": Arm(NOISY_EPOCHS, noise=NOISE),
    "noise-augmented-paper": Arm(NOISY_EPOCHS | AUGMENTED, noise=NOISE),
    "noise-every-update-dynamics": Arm(NOISY_EPOCHS | EVERY_UPDATE | DYNAMICS, noise=NOISE),
} | {control: Arm(method=control) for control in CONTROLS}
REPORTED_ARMS = {
    "random": (0,),
    "no-op": (0,),
    "oracle": (0,),
    "bc": (0,),
    "te-bc": (0,),
    "te-bc-horizon": (0,),
    "position-te-bc": (0,),
    "upn": (1,),
    "paper": (1,),
    "position-dynamics": (0, 5),
    "accurate-position-dynamics": (0, 5),
    "familiar-goals": (DEFAULT, APPROACHES),
}
"""Arms that are run on the reported tasks, with their numbers of updates."""
BEST = ("accurate-position-dynamics", "5")
"""Arm and number of updates that the others are compared with on the reported tasks."""
METHODS = {
    "random": (0,),
    "no-op": (0,),
    "oracle": (0,),
    "bc": (0,),
    "te-bc": (0,),
    "te-bc-horizon": (0,),
    "upn": (1,),
    "paper": (1,),
    "familiar-goals": (DEFAULT, APPROACHES),
}
"""Methods of the table of all tasks: controls, the paper's, and what is shipped."""
SHIPPED = ("familiar-goals", APPROACHES)
PAPER = ("paper", "1")
"""The paper's CPN, with which its other methods are compared."""
SEEDS = (0, 1)
TRIALS = 20

Outcomes = dict[str, dict[str, list[int]]]
"""1 for a success, 0 for a failure, of each variation in the order of seeds, by number of updates and task."""


@dataclass(frozen=True)
class Cell:
    """An arm trained with a seed on all tasks but a group."""

    group: str
    arm: str
    seed: int

    @property
    def result(self) -> Path:
        """File of the outcomes."""
        folder = RESULTS if self.group == "development" else RESULTS / self.group
        return folder / f"{self.arm}-{self.seed}.json"

    @property
    def tasks(self) -> tuple[str, ...]:
        """Evaluated tasks."""
        return GROUPS[self.group] + (TRAINED if self.group == "development" else ())

    @property
    def updates(self) -> tuple[int | str, ...]:
        """Numbers of updates to plan with; 0 alone for a method that does not plan."""
        if self.group != "development":
            return REPORTED_ARMS[self.arm]
        return ARMS[self.arm].updates if ARMS[self.arm].plans else (0,)

    def outcomes(self) -> Outcomes:
        """Kept outcomes; none if the cell was not run."""
        return json.loads(self.result.read_text())["successes"] if self.result.exists() else {}


def run(cell: Cell) -> None:
    """Trains and evaluates an arm on one core, and keeps the outcomes."""
    out, recipe = ROOT / f"runs/ablations/{cell.group}/{cell.arm}-{cell.seed}", ARMS[cell.arm]
    checkpoint = out / f"models/{recipe.method}.safetensors"
    checkpoint.parent.mkdir(parents=True, exist_ok=True)
    with Lab(out) as lab:
        if recipe.is_trained and not checkpoint.exists():
            settings = SETTINGS | recipe.settings
            options = ["--preset", f"paper-{recipe.method}", "--dataset", str(recipe.dataset), "--seed", str(cell.seed)]
            options += ["--hold-out", ",".join(GROUPS[cell.group]), "--run-dir", str(out / "run")]
            options += [option for name, value in settings.items() for option in ("--set", f"{name}={value}")]
            train(lab, checkpoint, *options)
        lab.planner(checkpoint.parent)
        lab.worker("w0")
        search = ["--models", recipe.method, "--tasks", ",".join(cell.tasks), "--trials", str(TRIALS)]
        for updates in cell.updates:
            lab.evaluate(
                *search, *recipe.evaluation, *_planning(recipe, updates), "--out", str(out / f"updates-{updates}")
            )
    keep(cell, out)


def _planning(recipe: Arm, updates: int | str) -> list[str]:
    """Options of an evaluation for plans with a number of updates."""
    if updates == APPROACHES or not recipe.plans:
        return []
    return ["--no-approaches"] if updates == DEFAULT else ["--updates", str(updates)]


def keep(cell: Cell, out: Path) -> None:
    """Keeps the outcomes of an arm's records."""
    recipe, successes = ARMS[cell.arm], Outcomes()
    for updates in cell.updates:
        by_task = successes.setdefault(str(updates), {})
        for path in sorted(out.glob(f"updates-{updates}/trials/*/{recipe.method}/*.json")):
            trial = json.loads(path.read_text())
            if trial["outcome"] != "solved-at-reset":
                by_task.setdefault(trial["task"], []).append(int(trial["outcome"] == "success"))
    result = {"arm": cell.arm, "seed": cell.seed, "method": recipe.method, "noise": recipe.noise}
    result |= {"held_out": GROUPS[cell.group], "settings": SETTINGS | recipe.settings if recipe.is_trained else {}}
    result |= {"successes": successes}
    cell.result.parent.mkdir(parents=True, exist_ok=True)
    cell.result.write_text(json.dumps(result) + "\n")


def development_table() -> str:
    """Successes on the development tasks by arm, training seed and number of updates, in Markdown."""
    lines = ["| arm | seed | U | development | trained | " + " | ".join(DEVELOPMENT) + " |"]
    lines.append("|---" * (5 + len(DEVELOPMENT)) + "|")
    for arm, seed in product(ARMS, SEEDS):
        for updates, by_task in Cell("development", arm, seed).outcomes().items():
            total = ["/".join(map(str, count(by_task, tasks))) for tasks in (DEVELOPMENT, TRAINED)]
            each = [str(sum(by_task[task])) for task in DEVELOPMENT]
            lines.append(f"| {arm} | {seed} | {updates} | " + " | ".join(total + each) + " |")
    return "\n".join(lines)


def columns(arms: Mapping[str, Iterable[int | str]], groups: Iterable[str], seeds: Iterable[int]) -> Columns:
    """Outcomes on the held-out tasks of groups, by arm and number of updates, and by task."""
    found = Columns()
    for (arm, all_updates), group, seed in product(arms.items(), groups, seeds):
        outcomes = Cell(group, arm, seed).outcomes()
        for updates in map(str, all_updates):
            for task in GROUPS[group] if updates in outcomes else ():
                row = found.setdefault(heading(arm, updates), {})
                row.setdefault(task, []).extend(outcomes[updates][task])
    return found


def heading(arm: str, updates: str) -> str:
    """Heading of a column."""
    if not ARMS[arm].plans:
        return arm
    return f"{arm}, U = {updates}" if updates.isdigit() else f"{arm}, {updates}"


def tables() -> list[str]:
    """Tables of the kept outcomes, in Markdown, as in docs/results/README.md."""
    reported = columns(REPORTED_ARMS, REPORTED, SEEDS)
    first_seed = columns(REPORTED_ARMS, REPORTED, SEEDS[:1])
    methods = columns(METHODS, GROUPS, SEEDS[:1])
    return [
        development_table(),
        task_table(reported),
        differences(heading(*BEST), first_seed),
        task_table(methods),
        differences(heading(*SHIPPED), methods),
        differences(heading(*PAPER), methods),
    ]


def ablations() -> None:
    """Runs all arms and prints the tables, or prints the tables alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--table", action="store_true", help="print the tables of the kept outcomes, and run nothing")
    parser.add_argument(
        "--groups", nargs="+", choices=GROUPS, default=["development"], help="groups of tasks to leave out"
    )
    parser.add_argument(
        "--arms", nargs="+", choices=ARMS, help="arms to run, by default all, or the reported ones of a reported group"
    )
    parser.add_argument("--seeds", nargs="+", type=int, choices=SEEDS, default=SEEDS, help="training seeds")
    arguments = parser.parse_args()
    unreported = [arm for arm in arguments.arms or () if arm not in REPORTED_ARMS]
    if unreported and set(arguments.groups) != {"development"}:
        parser.error(f"--arms: expected {', '.join(REPORTED_ARMS)} for a reported group, got {', '.join(unreported)}")
    if not arguments.table:
        cells = [
            Cell(group, arm, seed)
            for group, seed in product(arguments.groups, arguments.seeds)
            for arm in arguments.arms or (ARMS if group == "development" else REPORTED_ARMS)
            if ARMS[arm].is_trained or seed == SEEDS[0]
        ]
        record()
        if any(ARMS[cell.arm].noise for cell in cells):
            record(NOISY, NOISY_EPISODES, NOISE)
        # In processes, since each cell has a lab, whose signal handlers are for a process's main thread.
        with ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            for _ in pool.map(run, cells):
                pass
    print(*tables(), sep="\n\n")


if __name__ == "__main__":
    main(ablations)
