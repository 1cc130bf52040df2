"""The jobs of the workflow, each on a network of its own: `jobs.py JOB FOLDER CELL`, CELL in JSON.

A job leaves `cell.json` in its folder at its end. Interrupted, it goes on from what lies there. It runs in the
simulator's environment.
"""

import fcntl
import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1]))
import records
from lab import PROGRAMS, Lab, main, train

Cell = dict[str, Any]  # JSON; cells.py has the fields.

ELSEWHERE = {"title", "command", "planners", "models", "tasks", "trials"}
"""Parts of an evaluator's run that say nothing new of a cell."""


def demonstrate(folder: Path, cell: Cell) -> Cell:
    """Records the demonstrations and checks them."""
    recordings, episodes = folder / "recordings", str(cell["episodes"])
    with Lab(folder) as lab:
        lab.trainer(recordings)
        lab.demonstrate("--tasks", *cell["tasks"], "--episodes", episodes)

    verify = ["verify", "--dataset", str(recordings), "--tasks", str(len(cell["tasks"])), "--episodes", episodes]
    report = subprocess.run([PROGRAMS / "cpn-trainer", *verify, "--json"], check=True, stdout=subprocess.PIPE)
    return {"data_digest": json.loads(report.stdout)["digest"]}


def train_fold(folder: Path, cell: Cell) -> Cell:
    """Trains on every task but the fold's."""
    checkpoint, journal = folder / "model.safetensors", folder / "run"
    recordings = folder.parents[2] / "demonstrations" / cell["demonstrations"] / "recordings"
    options = ["--preset", cell["preset"], "--hold-out", cell["fold"], "--seed", str(cell["seed"])]
    options += ["--dataset", str(recordings), "--run-dir", str(journal)]
    for name, value in cell["settings"].items():
        options += ["--set", f"{name}={value}"]
    # The trainer writes it last. Killed just after, the job need not train again.
    if not checkpoint.exists():
        with Lab(folder) as lab:
            train(lab, checkpoint, *options)

    demonstrations = json.loads((recordings.parent / "cell.json").read_text())
    return {
        "weights": hashlib.sha256(checkpoint.read_bytes()).hexdigest(),
        "demonstrations": demonstrations["cell"]["episodes"],
        **records.training(journal / "progress.jsonl", checkpoint),
    }


def evaluate(folder: Path, cell: Cell) -> Cell:
    """Evaluates a model or a control on the fold's task."""
    models, out, trained = folder / "models", folder / "records", None
    models.mkdir(parents=True, exist_ok=True)
    if cell["training"]:
        training = folder.parents[2] / "training" / cell["fold"] / cell["training"]
        trained = json.loads((training / "cell.json").read_text())
        # A copy: a planner opens nothing outside of its folder.
        shutil.copyfile(training / "model.safetensors", models / f"{cell['method']}.safetensors")

    options = [f"--{name}" if value is True else f"--{name}={value}" for name, value in cell["options"].items()]
    options += ["--models", cell["method"], "--tasks", cell["fold"], "--trials", str(cell["trials"])]
    with Lab(folder) as lab:
        lab.planner(models)
        lab.worker("w0")
        lab.evaluate(*options, "--out", str(out))

    run = json.loads((out / "run.json").read_text())
    paths = (out / "trials" / cell["fold"] / cell["method"]).glob("*.json")
    trials = [json.loads(path.read_text()) for path in paths]
    # A variation that came to be left out later may have a record.
    trials = sorted(trials, key=lambda trial: trial["seed"])[: cell["trials"]]
    return {
        "evaluator": {key: value for key, value in run.items() if key not in ELSEWHERE},
        "weights": run["models"][0]["digest"],
        "trained": trained,
        **records.trials(trials),
    }


def _processor() -> str:
    """Model of this machine's processor: times depend on it, and the last bits of weights may."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), "unknown")


JOBS = {"demonstrate": demonstrate, "train": train_fold, "evaluate": evaluate}


def job() -> None:
    """Runs a job, and leaves its cell with its result."""
    name, folder, cell = sys.argv[1], Path(sys.argv[2]).absolute(), json.loads(sys.argv[3])
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".job.lock").open("w") as lock:
        # Where Snakemake alone was killed, its job may still be at work.
        fcntl.flock(lock, fcntl.LOCK_EX)
        contents = json.dumps({"cell": cell, **JOBS[name](folder, cell), "processor": _processor()}) + "\n"
        partial = folder / "cell.json.partial"
        partial.write_text(contents)
        partial.replace(folder / "cell.json")


if __name__ == "__main__":
    main(job)
