import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from cells import ROOT

HERE = ROOT / "experiments/leave_one_out"
TRAINED = {"bc", "te-bc", "te-bc-horizon", "upn", "cpn", "cpn-position"}


def dry_run(folder: Path, profile: str, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(HERE / "run.py"), "--profile", profile, "--folder", str(folder), "--jobs", "2"]
    return subprocess.run([*command, "--dry-run", *options], text=True, capture_output=True)


def counted(done: subprocess.CompletedProcess[str]) -> dict[str, int]:
    """Number of jobs by rule of a dry run."""
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in (done.stdout + done.stderr).splitlines()]
    return {line[0]: int(line[1]) for line in lines if len(line) == 2 and line[1].isdecimal()}


@pytest.mark.parametrize(("profile", "training", "evaluation"), [("desk", 144, 408), ("paper", 360, 1008)])
def test_a_profile_has_the_jobs_of_its_folds_methods_and_seeds(
    tmp_path: Path, profile: str, training: int, evaluation: int
) -> None:
    """Results in the repository are not computed again, and a report of some folds does not end the experiment."""
    there = [path.stem for path in (ROOT / "docs/results/leave_one_out" / profile).glob("*/*-*.json")]
    trained = [stem for stem in there if stem.rpartition("-")[0] in TRAINED]
    jobs = counted(dry_run(tmp_path, profile))
    expected = (int(len(there) < evaluation), training - len(trained), evaluation - len(there))
    assert tuple(jobs.get(rule, 0) for rule in ("demonstrations", "train", "evaluate")) == expected


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("trails=3", "'trails' was unexpected"),
        ("trials=0", "0 is less than the minimum of 1"),
        ("folds=[door-lok]", "folds: expected some of door-lock, drawer-close, plate-slide, got door-lok"),
        ("methods=[magic]", "methods: expected some of random, .*, got magic"),
    ],
)
def test_a_profile_that_is_wrong_is_refused_before_anything_runs(tmp_path: Path, setting: str, message: str) -> None:
    done = dry_run(tmp_path, "smoke", "--config", setting)
    assert done.returncode == 1
    text = done.stdout + done.stderr
    assert message.partition(".*")[0] in text
    assert message.rpartition(".*")[2] in text


def test_no_executor_lets_provenance_or_a_lock_decide_what_runs() -> None:
    common = yaml.safe_load((HERE / "common/config.yaml").read_text())
    assert common["rerun-triggers"] == ["mtime"]
    for executor in (HERE / "executors").iterdir():
        settings = yaml.safe_load((executor / "config.yaml").read_text())
        assert not settings.keys() & common.keys(), f"{executor.name} overrides what holds everywhere"
