import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from cells import ROOT

HERE = ROOT / "experiments/leave_one_out"


def dry_run(folder: Path, profile: str, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(HERE / "run.py"), "--profile", profile, "--folder", str(folder), "--jobs", "2"]
    return subprocess.run([*command, "--dry-run", *options], text=True, capture_output=True)


@pytest.mark.parametrize(("profile", "training", "evaluation"), [("desk", 120, 384), ("paper", 360, 1008)])
def test_a_profile_has_the_jobs_of_its_folds_methods_and_seeds(
    tmp_path: Path, profile: str, training: int, evaluation: int
) -> None:
    done = dry_run(tmp_path, profile)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in (done.stdout + done.stderr).splitlines()]
    jobs = {line[0]: int(line[1]) for line in lines if len(line) == 2 and line[1].isdecimal()}
    assert (jobs["demonstrations"], jobs["train"], jobs["evaluate"]) == (1, training, evaluation)


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
