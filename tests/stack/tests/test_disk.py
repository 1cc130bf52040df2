"""Disks that are full: a clear error, nothing half written, and on once there is room."""

import json
import uuid
from collections.abc import Iterator

import pytest
from conftest import MODELS, TASKS, TRIALS
from test_demonstrations import demonstrate, ended

from cpn_stack.docker import docker, inspect, logs, read_folder, wait_until
from cpn_stack.evaluation import Records
from cpn_stack.stack import USER, Stack

FULL = "No space left on device"


class SmallDisk:
    """A volume in memory that holds a few megabytes, and a container that keeps it."""

    def __init__(self, size: str) -> None:
        self.name = f"cpn-stack-disk-{uuid.uuid4().hex[:8]}"
        size_and_owner = f"o=size={size},uid={USER},gid={USER}"
        options = ["--opt", "type=tmpfs", "--opt", "device=tmpfs", "--opt", size_and_owner]
        docker("volume", "create", *options, self.name)
        docker(
            "run",
            "--detach",
            "--name",
            self.name,
            "--init",
            f"--volume={self.name}:/small",
            "debian:bookworm-slim",
            "sleep",
            "inf",
        )

    def run(self, command: str) -> str:
        return docker("exec", "--user", str(USER), self.name, "sh", "-c", command)

    def fill(self) -> None:
        self.run("dd if=/dev/zero of=/small/filler bs=4K 2>/dev/null; true")

    def make_room(self) -> None:
        self.run("rm /small/filler")

    def remove(self) -> None:
        users = docker("ps", "--all", "--quiet", "--filter", f"volume={self.name}").split()
        docker("rm", "--force", *users)
        docker("volume", "rm", self.name)


@pytest.fixture
def disk() -> Iterator[SmallDisk]:
    disk = SmallDisk("64m")
    yield disk
    disk.remove()


def test_full_disk_under_an_evaluator(stack: Stack, undisturbed: Records, disk: SmallDisk) -> None:
    options = [f"--volume={disk.name}:/small"]

    first = stack.evaluate("full", tasks=TASKS, models=MODELS, trials=TRIALS, options=options, out="/small")
    first.wait_for_trials(10)
    disk.fill()
    assert first.wait() != 0
    assert FULL in first.log(), first.log()
    assert "writing /small/full/" in first.log(), first.log()
    # Every record that is there is whole.
    for path, content in read_folder(first.container, "/small/full").items():
        if path.endswith(".json"):
            json.loads(content)

    disk.make_room()
    second = stack.evaluate("full", tasks=TASKS, models=MODELS, trials=TRIALS, options=options, out="/small")
    assert second.wait() == 0, second.log()
    assert "trials are there already" in second.log()
    assert second.records() == undisturbed


def test_full_disk_under_a_trainer(stack: Stack, disk: SmallDisk) -> None:
    """The recorder tells of it, demonstrations wait, and go on when there is room."""
    stack.stop(stack.container("trainer"))
    options = [f"--volume={disk.name}:/small"]
    for variable, folder in (("DATASET", "demonstrations"), ("CHECKPOINTS", "checkpoints"), ("RUNS", "training")):
        options += ["-e", f"CPN_TRAINER_{variable}=/small/{folder}"]
    trainer = stack.run("trainer", options=options)
    demonstrations = demonstrate(stack)
    kept = "find /small/demonstrations -name '*.mcap' | wc -l"
    wait_until("an episode is kept", lambda: int(disk.run(kept)) >= 1)
    disk.fill()
    wait_until("the trainer tells", lambda: FULL in logs(trainer))
    assert inspect(trainer, ".State.Running") == "true"
    disk.make_room()
    wait_until("the demonstrations end", lambda: ended(demonstrations))
    again = demonstrations
    if inspect(demonstrations, ".State.ExitCode") != "0":
        assert FULL in logs(demonstrations), logs(demonstrations)
        again = demonstrate(stack)
        wait_until("the demonstrations end", lambda: ended(again))
    assert inspect(again, ".State.ExitCode") == "0", logs(again)
    arguments = ["verify", "--dataset", "/small/demonstrations", "--tasks", "2", "--episodes", "8", "--json"]
    assert json.loads(docker("exec", trainer, "cpn-trainer", *arguments))["faults"] == []
    assert disk.run("find /small -name '.unfinished-*'") == ""
    docker("rm", "--force", trainer)
