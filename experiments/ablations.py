"""Ablations of losses and noise injection on the development tasks, which are left out of training all at once.

Interrupted, it goes on. Each run's outcomes are kept in docs/results/ablations, of which --table makes the table.
"""

import argparse
import json
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

from dataset import DATASET, record
from lab import ROOT, Lab, main, on_every_core, train

RESULTS = ROOT / "docs/results/ablations"
DEVELOPMENT = ("coffee-button", "dial-turn", "door-lock", "drawer-close", "handle-press", "handle-pull")
"""The four tasks that the paper names, and two that `random.Random(0)` drew of the 20 others, in the order of names."""
TRAINED = ("plate-slide", "window-close")
"""Tasks of the training demonstrations, on other variations."""

SETTINGS = {"training.epochs": 3, "training.samples_per_draw": 8, "training.precision": "bfloat16"}
EVERY_UPDATE = {"training.losses.every_update": "true"}
DYNAMICS = {"training.losses.dynamics": 0.5}
POSITION = {"training.losses.position": 0.3}
NOISY, NOISE, NOISY_EPISODES = ROOT / "data/demonstrations-noise", 0.3, 50
"""Demonstrations with noise injection."""
NOISY_EPOCHS = {"training.epochs": 6}
"""As many updates of the weights as with twice the episodes and half the epochs."""
AUGMENTED = {"training.goals": "hindsight", "training.shift_pixels": 4}


@dataclass(frozen=True)
class Arm:
    """Recipe of an arm."""

    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of training beside `SETTINGS`."""
    method: str = "cpn"
    noise: float = 0
    """Noise injection of the demonstrations."""

    @property
    def dataset(self) -> Path:
        """Folder of the demonstrations."""
        return NOISY if self.noise else DATASET

    @property
    def plans(self) -> bool:
        """Whether the method plans, with a number of updates."""
        return self.method == "cpn"


ARMS = {
    "paper": Arm(),
    "every-update": Arm(EVERY_UPDATE),
    "every-update-dynamics": Arm(EVERY_UPDATE | DYNAMICS),
    "every-update-dynamics-position": Arm(EVERY_UPDATE | DYNAMICS | POSITION),
    "noise-te-bc": Arm(NOISY_EPOCHS, "te-bc", NOISE),
    "noise-augmented-te-bc": Arm(NOISY_EPOCHS | AUGMENTED, "te-bc", NOISE),
    "noise-paper": Arm(NOISY_EPOCHS, noise=NOISE),
    "noise-augmented-paper": Arm(NOISY_EPOCHS | AUGMENTED, noise=NOISE),
    "noise-every-update-dynamics": Arm(NOISY_EPOCHS | EVERY_UPDATE | DYNAMICS, noise=NOISE),
}
SEEDS = (0, 1)
UPDATES = (0, 1, 5)
TRIALS = 20

Outcomes = dict[str, dict[str, list[int]]]
"""1 for a success, 0 for a failure, of each variation in the order of seeds, by number of updates and task."""


def run(arm: str, seed: int) -> None:
    """Trains and evaluates an arm on one core, and keeps the outcomes."""
    out, recipe = ROOT / f"runs/ablations/{arm}-{seed}", ARMS[arm]
    checkpoint = out / f"models/{recipe.method}.safetensors"
    checkpoint.parent.mkdir(parents=True, exist_ok=True)
    settings = SETTINGS | recipe.settings
    options = ["--preset", f"paper-{recipe.method}", "--dataset", str(recipe.dataset), "--seed", str(seed)]
    options += ["--hold-out", ",".join(DEVELOPMENT), "--run-dir", str(out / "run")]
    options += [option for name, value in settings.items() for option in ("--set", f"{name}={value}")]
    with Lab(out) as lab:
        if not checkpoint.exists():
            train(lab, checkpoint, *options)
        lab.planner(checkpoint.parent)
        lab.worker("w0")
        search = ["--models", recipe.method, "--tasks", ",".join(DEVELOPMENT + TRAINED), "--trials", str(TRIALS)]
        for updates in UPDATES if recipe.plans else (0,):
            choice = ["--updates", str(updates)] if recipe.plans else []
            lab.evaluate(*search, *choice, "--out", str(out / f"updates-{updates}"))
    keep(arm, seed, out)


def keep(arm: str, seed: int, out: Path) -> None:
    """Keeps the outcomes of an arm's records."""
    successes: Outcomes = {}
    for folder in sorted(out.glob("updates-*")):
        for path in sorted(folder.glob(f"trials/*/{ARMS[arm].method}/*.json")):
            trial = json.loads(path.read_text())
            by_task = successes.setdefault(folder.name.removeprefix("updates-"), {})
            by_task.setdefault(trial["task"], []).append(int(trial["outcome"] == "success"))
    recipe = ARMS[arm]
    result = {"arm": arm, "seed": seed, "method": recipe.method, "noise": recipe.noise}
    result |= {"settings": SETTINGS | recipe.settings, "successes": successes}
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / f"{arm}-{seed}.json").write_text(json.dumps(result) + "\n")


def table() -> str:
    """Successes by arm, training seed and number of updates, in Markdown."""
    lines = ["| arm | seed | U | development | trained | " + " | ".join(DEVELOPMENT) + " |"]
    lines.append("|---" * (5 + len(DEVELOPMENT)) + "|")
    for arm, seed in product(ARMS, SEEDS):
        path = RESULTS / f"{arm}-{seed}.json"
        outcomes: Outcomes = json.loads(path.read_text())["successes"] if path.exists() else {}
        for updates, by_task in outcomes.items():
            total = ["/".join(map(str, _count(by_task, tasks))) for tasks in (DEVELOPMENT, TRAINED)]
            each = [str(sum(by_task[task])) for task in DEVELOPMENT]
            lines.append(f"| {arm} | {seed} | {updates} | " + " | ".join(total + each) + " |")
    return "\n".join(lines)


def _count(by_task: dict[str, list[int]], tasks: tuple[str, ...]) -> tuple[int, int]:
    """Successes and trials."""
    outcomes = [outcome for task in tasks for outcome in by_task[task]]
    return sum(outcomes), len(outcomes)


def ablations() -> None:
    """Runs all arms and prints the table, or prints the table alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--table", action="store_true", help="print the table of the kept outcomes, and run nothing")
    if not parser.parse_args().table:
        record()
        record(NOISY, NOISY_EPISODES, NOISE)
        on_every_core(lambda cell: run(*cell), product(ARMS, SEEDS))
    print(table())


if __name__ == "__main__":
    main(ablations)
