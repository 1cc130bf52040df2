import logging
import signal
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cpn_stack import docker as engine
from cpn_stack.evaluation import Evaluation, Records
from cpn_stack.metrics import Metrics
from cpn_stack.stack import Stack

log = logging.getLogger(__name__)

TASKS, MODELS = "drawer-close,plate-slide", "cpn,te-bc"
TRIALS = 16
"""Variations of each task: 64 trials, which take a minute."""


def pytest_sessionstart(session: pytest.Session) -> None:
    del session
    # So that the stack is taken down.
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: pytest.exit("told to stop"))
    if reason := engine.missing():
        warnings.warn(f"THE STACK IS NOT TESTED HERE: {reason}", stacklevel=1)


@pytest.fixture(scope="session")
def whole_stack() -> Iterator[Stack]:
    if reason := engine.missing():
        pytest.skip(f"THE STACK IS NOT TESTED HERE: {reason}")
    stack = Stack()
    try:
        stack.up()
        yield stack
    finally:
        stack.down()


@pytest.fixture
def stack(whole_stack: Stack) -> Stack:
    """Everything is up, whatever the test before did."""
    whole_stack.up()
    return whole_stack


@pytest.fixture(scope="session")
def undisturbed(whole_stack: Stack) -> Records:
    """The records of an evaluation that nothing happens to."""
    evaluation = whole_stack.evaluate("undisturbed", tasks=TASKS, models=MODELS, trials=TRIALS)
    assert evaluation.wait() == 0, evaluation.log()
    assert "begins anew" not in evaluation.log()
    records = evaluation.records()
    assert len(records) == 4 * TRIALS
    # Otherwise a table could be right by accident.
    assert {record["outcome"] for record in records.values()} == {"success", "failure"}
    return records


@pytest.fixture
def evaluate(stack: Stack, undisturbed: Records, request: pytest.FixtureRequest) -> Callable[[], Evaluation]:
    """Starts an evaluation named after the test, and waits until it is under way."""

    def start() -> Evaluation:
        assert undisturbed
        name = request.node.name.removeprefix("test_")
        evaluation = stack.evaluate(name, tasks=TASKS, models=MODELS, trials=TRIALS)
        evaluation.wait_for_trials(1)
        return evaluation

    return start


@pytest.fixture
def check(undisturbed: Records) -> Callable[[Evaluation], None]:
    """Waits for the end of an evaluation, and holds its records to those of the undisturbed one."""

    def check(evaluation: Evaluation) -> None:
        code = evaluation.wait()
        log.info(
            "%s", "\n".join(line for line in evaluation.log().splitlines() if " WARN " in line or " ERROR " in line)
        )
        assert code == 0, evaluation.log()
        assert evaluation.records() == undisturbed, evaluation.log()

    return check


@pytest.fixture(scope="session")
def certificates(whole_stack: Stack, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder with the certificates of a role."""
    folders: dict[str, Path] = {}

    def folder(role: str) -> Path:
        if role not in folders:
            folders[role] = whole_stack.certificates(role, tmp_path_factory.mktemp(role))
        return folders[role]

    return folder


@pytest.fixture
def metrics(stack: Stack, certificates: Callable[[str], Path]) -> list[Metrics]:
    """Those of the planners."""
    ports = [stack.ports[f"CPN_TEST_PORT_METRICS_{number}"] for number in (0, 1)]
    return [Metrics(port, certificates("viewer")) for port in ports]
