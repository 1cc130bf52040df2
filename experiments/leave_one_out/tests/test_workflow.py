"""The smoke profile as a whole, killed on its way, with the services' programs and the simulator."""

import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pairs
import psutil
import pytest
import yaml
from cells import ROOT
from PIL import Image
from results import Results

HERE = ROOT / "experiments/leave_one_out"
NOTHING = "Nothing to be done"
FINISHED = ("*/**/cell.json", "training/**/model.safetensors", "evaluation/**/trials/**/*.json", "smoke/*/*-*.json")
"""Files that nothing may write again."""


def command(folder: Path, *options: str, here: Path = HERE) -> list[str]:
    return [
        sys.executable,
        str(here / "run.py"),
        "--profile",
        "smoke",
        "--folder",
        str(folder),
        "--jobs",
        "2",
        *options,
    ]


def run(folder: Path, *options: str, here: Path = HERE) -> str:
    done = subprocess.run(
        command(folder, *options, here=here), text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def kill_when(folder: Path, reached: Callable[[], bool]) -> None:
    """Starts the experiment and kills every process of it as soon as a point is reached."""
    with (folder.parent / "killed.log").open("w") as log:
        process = subprocess.Popen(command(folder), stdout=log, stderr=log, start_new_session=True)
    try:
        while not reached():
            assert process.poll() is None, "ended before it could be killed"
            time.sleep(0.02)
        members = [p for p in psutil.Process(process.pid).children(recursive=True) if os.getpgid(p.pid) == process.pid]
        assert members, "killed without a job"
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    psutil.wait_procs(members)


def finished(folder: Path) -> dict[Path, int]:
    """When each finished file was written."""
    return {path: path.stat().st_mtime_ns for pattern in FINISHED for path in folder.glob(pattern)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an experiment that was killed three times and then ran to its end."""
    folder = tmp_path_factory.mktemp("leave_one_out") / "runs"
    kill_when(folder, lambda: any(folder.glob("demonstrations/*/recordings/*/*.mcap")))
    kill_when(folder, lambda: any(folder.glob("training/*/*/run/progress.jsonl")))
    kill_when(folder, lambda: any(folder.glob("evaluation/**/trials/*/cpn/*.json")))
    before = finished(folder)
    assert before
    run(folder)
    after = finished(folder)
    assert {path: after[path] for path in before} == before
    return folder


def test_a_killed_experiment_goes_on_and_every_cell_says_what_it_is_made_of(folder: Path) -> None:
    results = {
        path.relative_to(folder / "smoke"): json.loads(path.read_text()) for path in folder.glob("smoke/*/*-*.json")
    }
    profile = yaml.safe_load((HERE / "profiles/smoke.yaml").read_text())
    # One of its methods plans.
    evaluated = len(profile["methods"]) + len(profile["updates"])
    assert len(results) == len(profile["folds"]) * evaluated * len(profile["seeds"])
    for path, result in results.items():
        assert result["cell"]["fold"] == path.parts[0]
        assert len(result["seeds"]) == len(result["successes"]) == len(result["steps"]) == 2
        for points in result["latent_distance"].values():
            assert all(step % 5 == 0 for step, *_ in points)
        if result["cell"]["method"] in {"bc", "cpn"}:
            assert any(result["latent_distance"].values())
            assert result["trained"]["curve"][-1][0] == result["trained"]["samples"]
            assert result["weights"] == result["trained"]["weights"]
            assert result["trained"]["cell"]["settings"]["training.epochs"] == 1
            assert len(result["trained"]["data_digest"]) == 64
    report = (folder / "smoke/report.html").read_text()
    assert report.startswith("<!doctype html>")
    assert not re.search(r'(src|href)="(?!#|data:)', report), "not self-contained"


def test_a_pair_of_episodes_is_drawn_from_their_recordings(folder: Path, tmp_path: Path) -> None:
    results = tmp_path / "smoke"
    shutil.copytree(folder / "smoke", results)
    for method, successes in (("bc", [0, 0]), ("cpn", [0, 1])):
        path = results / f"door-lock/{method}-0.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"successes": successes}))
    found = Results.read(results)
    pair, *recordings = next(chosen for chosen in pairs.pairs(found, folder) if chosen[0]["task"] == "door-lock")
    seed = found.variations["door-lock"][1]
    assert pair == {"task": "door-lock", "seed": seed, "solved": "cpn", "failed": "bc"}
    (goal, solved), (same_goal, failed) = (pairs.read_frames(recording) for recording in recordings)
    assert goal == same_goal
    assert solved[0] == failed[0], "one variation"
    assert solved[0] not in (solved[-1], failed[-1], goal), "the arm moves"

    pairs.main(results, folder)
    pair = next(pair for pair in json.loads((results / "pairs/pairs.json").read_text()) if pair["task"] == "door-lock")
    strip, animation = (Image.open(results / "pairs" / pair[kind]) for kind in ("strip", "animation"))
    assert strip.size == (7 * 84, 2 * 84)
    assert animation.size == (3 * 84, 84)
    assert getattr(animation, "n_frames", 1) > 1

    shutil.rmtree(results / "pairs")
    pairs.main(results, tmp_path)
    assert json.loads((results / "pairs/pairs.json").read_text()) == [], "no recordings, no pairs"


def test_a_folder_has_one_run_at_a_time(folder: Path) -> None:
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        refused = subprocess.run(command(folder), text=True, capture_output=True)
    assert refused.returncode == 1
    assert "expected a folder that no run works in, got that of another run" in refused.stderr


def test_what_is_finished_is_not_run_again(folder: Path, tmp_path: Path) -> None:
    assert NOTHING in run(folder, "--dry-run")

    # Times of files say nothing of a cell.
    for cell in folder.glob("demonstrations/*/cell.json"):
        cell.touch()
    for cell in folder.glob("training/*/*/cell.json"):
        cell.touch()
    assert NOTHING in run(folder, "--dry-run")

    # Nor do the rules, which provenance would watch: without our pinned triggers, the same change runs cells again.
    here = tmp_path / "experiments/leave_one_out"
    shutil.copytree(HERE, here, ignore=shutil.ignore_patterns(".venv", "tests"))
    for part in ("sim-worker", "crates", "services", "Cargo.lock", "docs"):
        (tmp_path / part).symlink_to(ROOT / part)
    snakefile = here / "Snakefile"
    snakefile.write_text(snakefile.read_text().replace('"{RUN} train', '"nice {RUN} train'))
    assert NOTHING in run(folder, "--dry-run", here=here)

    # Of a cell without its result, too.
    result = next(folder.glob("smoke/*/cpn-0.json"))
    aside = result.rename(tmp_path / result.name)
    pinned = run(folder, "--dry-run", here=here)
    again = run(folder, "--dry-run", "--rerun-triggers", "mtime", "code", "params", here=here)
    aside.rename(result)
    assert "rule result" in pinned
    assert "rule train" not in pinned
    assert "rule train" in again


def slurm_answers() -> bool:
    sinfo = shutil.which("sinfo")
    return sinfo is not None and subprocess.run([sinfo], capture_output=True).returncode == 0


@pytest.mark.skipif(not slurm_answers(), reason="no Slurm answers")
def test_the_experiment_runs_through_slurm_and_is_finished_there_too(tmp_path: Path) -> None:
    log = run(tmp_path, "--executor", "slurm", "--cores", "2")
    assert "has been submitted with SLURM jobid" in log
    assert (tmp_path / "smoke/report.html").exists()
    assert NOTHING in run(tmp_path, "--executor", "slurm", "--cores", "2", "--dry-run")
