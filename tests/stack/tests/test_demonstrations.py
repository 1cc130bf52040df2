"""A trainer that is killed while it records."""

import json
import logging

from cpn_stack.docker import docker, inspect, logs, wait_until
from cpn_stack.stack import Stack

TASKS, EPISODES = ("drawer-close", "reach"), 8

log = logging.getLogger(__name__)


def demonstrate(stack: Stack) -> str:
    options = ["--episodes", str(EPISODES), "--processes", "2", "--tasks", *TASKS]
    return stack.run("demonstrations", "demonstrate", *options)


def verify(stack: Stack) -> tuple[str, list[int]]:
    """Digest of the dataset, and episodes of each task."""
    arguments = ["verify", "--dataset", "/data/demonstrations", "--tasks", "2", "--episodes", str(EPISODES), "--json"]
    report = json.loads(docker("exec", stack.container("trainer"), "cpn-trainer", *arguments))
    assert report["faults"] == []
    return report["digest"], [task["episodes"] for task in report["tasks"]]


def episodes(stack: Stack) -> int:
    command = "find /data/demonstrations -name '*.mcap' | wc -l"
    return int(docker("exec", stack.container("trainer"), "sh", "-c", command))


def ended(container: str) -> bool:
    return inspect(container, ".State.Running") == "false"


def test_trainer_killed_during_demonstrations(stack: Stack) -> None:
    trainer = stack.container("trainer")
    calm = demonstrate(stack)
    wait_until("the demonstrations end", lambda: ended(calm))
    assert inspect(calm, ".State.ExitCode") == "0", logs(calm)
    expected = verify(stack)
    assert expected[1] == [EPISODES, EPISODES]

    docker("exec", trainer, "sh", "-c", "rm -r /data/demonstrations")
    stack.kill(trainer)
    stack.start(trainer)
    stack.wait_healthy("trainer")
    rough = demonstrate(stack)
    for kept in (2, 5, 9):
        wait_until(f"{kept} episodes are kept", lambda least=kept: episodes(stack) >= least)
        assert not ended(rough), logs(rough)
        stack.kill(trainer)
        stack.start(trainer)
        stack.wait_healthy("trainer")
    wait_until("the demonstrations end", lambda: ended(rough))
    log.info("%s", logs(rough)[-2000:])
    assert inspect(rough, ".State.ExitCode") == "0", logs(rough)
    assert verify(stack) == expected
