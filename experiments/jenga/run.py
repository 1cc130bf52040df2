"""The paper's Jenga experiment in the simulated arm.

21 demonstrations, a model of positions for each horizon and number of updates, the pair whose plans end nearest to the
trained targets, then plans to trained and to offset targets, executed. An interrupted run resumes.
"""

import sys
from pathlib import Path

from choose import choose
from execute import execute
from report import report

sys.path.append(str(Path(__file__).resolve().parents[1]))
from lab import PROGRAMS, ROOT, Lab, main, on_every_core, train

GRID = ((8, 2), (8, 1), (5, 2), (3, 2), (5, 1), (3, 1), (1, 2), (1, 1))
"""Horizons and updates to choose from."""
SEEDS = (0, 1, 2)
"""Training seeds of the chosen pair."""
DEMONSTRATIONS = 21
DATASET = ROOT / "data/jenga"
OUT = ROOT / "runs/jenga"
WORKERS = ("w0", "w1")


def train_missing(lab: Lab, out: Path, horizon: int, updates: int, seed: int, goals: str) -> None:
    """Trains a model of positions, unless it is there."""
    if out.exists():
        return
    settings = {"model.horizon": horizon, "model.updates": updates, "training.goals": goals}
    options = [option for name, value in settings.items() for option in ("--set", f"{name}={value}")]
    options += ["--preset", "jenga", "--dataset", str(DATASET), "--seed", str(seed)]
    train(lab, out, *options, "--run-dir", str(out.with_suffix("")))


def names(folder: Path) -> list[str]:
    """Models of a folder."""
    return sorted(path.stem for path in folder.glob("*.safetensors"))


def jenga() -> None:
    """Leaves report and trajectories in a folder of runs/jenga that is named after the chosen pair."""
    episodes = [f"jenga-poke-{seed}" for seed in range(DEMONSTRATIONS)]
    with Lab(OUT) as lab:
        lab.trainer(DATASET)
        lab.demonstrate("--tasks", "jenga-poke", "--episodes", str(DEMONSTRATIONS))
        verify = ["verify", "--dataset", str(DATASET), "--episodes", str(DEMONSTRATIONS)]
        lab.run([str(PROGRAMS / "cpn-trainer"), *verify])

        grid = OUT / "grid"
        grid.mkdir(exist_ok=True)
        on_every_core(
            lambda pair: train_missing(lab, grid / f"h{pair[0]}-u{pair[1]}.safetensors", *pair, 0, "final"), GRID
        )
        lab.planner(grid, name="grid")
        horizon, updates = choose(lab.endpoint, "grid", OUT / "grid.json", episodes, names(grid))
        print(f"chosen: H = {horizon}, U = {updates}")

        chosen = OUT / f"chosen-h{horizon}-u{updates}"
        chosen.mkdir(exist_ok=True)
        runs = [
            (method, goals, seed) for seed in SEEDS for method, goals in (("cpn", "final"), ("hindsight", "hindsight"))
        ]
        on_every_core(
            lambda run: train_missing(lab, chosen / f"{run[0]}-{run[2]}.safetensors", horizon, updates, run[2], run[1]),
            runs,
        )
        lab.planner(chosen, name=chosen.name)
        for worker in WORKERS:
            lab.worker(worker)
        execute(lab.endpoint, chosen.name, chosen, episodes, list(WORKERS), names(chosen))
    report(chosen)


if __name__ == "__main__":
    main(jenga)
