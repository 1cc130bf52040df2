"""The paper's Jenga experiment in the simulated arm.

21 demonstrations; for each recipe, a model of positions for each horizon and number of updates, and the pair whose
plans end nearest to the trained targets; then plans to trained and to offset targets, executed. An interrupted run
resumes.
"""

import sys
from itertools import product
from pathlib import Path

from choose import choose
from execute import execute
from report import report

sys.path.append(str(Path(__file__).resolve().parents[1]))
from lab import PROGRAMS, ROOT, Lab, LabError, main, on_every_core, train

GRIDS = {
    "jenga": ((8, 2), (8, 1), (5, 2), (3, 2), (5, 1), (3, 1), (1, 2), (1, 1)),
    "jenga-position": tuple(product((8, 5, 3, 1), (5, 2, 1))),
}
"""Horizons and updates to choose from, by preset."""
MODELS = {"cpn": ("jenga", "final"), "hindsight": ("jenga", "hindsight"), "position": ("jenga-position", "final")}
"""Preset and goals of the executed models."""
SEEDS = (0, 1, 2)
"""Training seeds of the executed models."""
DEMONSTRATIONS = 21
DATASET = ROOT / "data/jenga"
OUT = ROOT / "runs/jenga"
WORKERS = ("w0", "w1")


def train_missing(lab: Lab, out: Path, preset: str, pair: tuple[int, int], seed: int, goals: str) -> None:
    """Trains a model of positions with a horizon and a number of updates, unless it is there."""
    if out.exists():
        return
    settings = {"model.horizon": pair[0], "model.updates": pair[1], "training.goals": goals}
    options = [option for name, value in settings.items() for option in ("--set", f"{name}={value}")]
    options += ["--preset", preset, "--dataset", str(DATASET), "--seed", str(seed)]
    train(lab, out, *options, "--run-dir", str(out.with_suffix("")))


def names(folder: Path) -> list[str]:
    """Models of a folder."""
    return sorted(path.stem for path in folder.glob("*.safetensors"))


def choose_pair(lab: Lab, preset: str, episodes: list[str]) -> tuple[int, int]:
    """Horizon and number of updates of a preset, by the paper's rule; a pair whose training diverges is left out."""
    grid = OUT / f"grid-{preset}"
    grid.mkdir(exist_ok=True)

    diverged: list[str] = []

    def train_pair(pair: tuple[int, int]) -> None:
        try:
            train_missing(lab, grid / f"h{pair[0]}-u{pair[1]}.safetensors", preset, pair, 0, "final")
        except LabError as error:
            if "loss: expected a finite number" not in str(error):
                raise
            diverged.append(f"h{pair[0]}-u{pair[1]}")

    on_every_core(train_pair, GRIDS[preset])
    lab.planner(grid, name=grid.name)
    pair = choose(lab.endpoint, grid.name, grid.with_suffix(".json"), episodes, names(grid), diverged)
    print(f"{preset}: chosen H = {pair[0]}, U = {pair[1]}")
    return pair


def jenga() -> None:
    """Leaves report and trajectories in a folder of runs/jenga that is named after the chosen pairs."""
    episodes = [f"jenga-poke-{seed}" for seed in range(DEMONSTRATIONS)]
    with Lab(OUT) as lab:
        lab.trainer(DATASET)
        lab.demonstrate("--tasks", "jenga-poke", "--episodes", str(DEMONSTRATIONS))
        verify = ["verify", "--dataset", str(DATASET), "--episodes", str(DEMONSTRATIONS)]
        lab.run([str(PROGRAMS / "cpn-trainer"), *verify])

        pairs = {preset: choose_pair(lab, preset, episodes) for preset in GRIDS}
        chosen = OUT / "-".join(["chosen", *(f"h{horizon}-u{updates}" for horizon, updates in pairs.values())])
        chosen.mkdir(exist_ok=True)

        def train_model(run: tuple[int, str]) -> None:
            seed, name = run
            preset, goals = MODELS[name]
            train_missing(lab, chosen / f"{name}-{seed}.safetensors", preset, pairs[preset], seed, goals)

        on_every_core(train_model, list(product(SEEDS, MODELS)))
        lab.planner(chosen, name=chosen.name)
        for worker in WORKERS:
            lab.worker(worker)
        execute(lab.endpoint, chosen.name, chosen, episodes, list(WORKERS), names(chosen))
    report(chosen)


if __name__ == "__main__":
    main(jenga)
