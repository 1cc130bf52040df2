import logging
import os
import signal
import subprocess
from collections.abc import Iterator

import pytest
import zenoh

from cpn_sim_worker import keys
from cpn_sim_worker.render import process_renderer
from cpn_sim_worker.session import ZenohConfig, open_session
from cpn_sim_worker.simulator import Simulator
from tests.support import COMMAND, READY_SECONDS, Log, StartWorker, collect, free_endpoint, wait_for_sample


@pytest.fixture(scope="session", autouse=True)
def _no_options_from_outside() -> Iterator[None]:
    """Unsets the environment variables of options, also for the processes under test."""
    with pytest.MonkeyPatch.context() as patch:
        for variable in [name for name in os.environ if name.startswith("CPN_") or name == "ZENOH_CONFIG"]:
            patch.delenv(variable)
        yield


@pytest.fixture(scope="session")
def simulator() -> Simulator:
    """Simulator of the session, with the only renderer that a process can have."""
    return Simulator(process_renderer())


@pytest.fixture(scope="session")
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture(scope="session")
def session(endpoint: str) -> Iterator[zenoh.Session]:
    """Peer that all processes under test connect to."""
    with open_session(ZenohConfig(listen=(endpoint,))) as session:
        yield session


@pytest.fixture(scope="session")
def start_worker(session: zenoh.Session, endpoint: str) -> Iterator[StartWorker]:
    """Starts a serving process and waits until it is ready."""
    workers: list[subprocess.Popen[bytes]] = []

    def start(name: str, *options: str) -> subprocess.Popen[bytes]:
        ready = session.liveliness().declare_subscriber(keys.sim_alive(name), collect())
        process = subprocess.Popen([COMMAND, "serve", "--worker", name, "--connect", endpoint, *options])
        workers.append(process)
        wait_for_sample(ready, zenoh.SampleKind.PUT)
        ready.undeclare()
        return process

    yield start
    for process in workers:
        if process.poll() is None:
            os.kill(process.pid, signal.SIGTERM)
    for process in workers:
        assert process.wait(timeout=READY_SECONDS) == 0


@pytest.fixture
def session_log() -> Iterator[Log]:
    """Log of the test's sessions."""
    handler = Log()
    logger = logging.getLogger("cpn_sim_worker.session")
    level = logger.level
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    yield handler
    logger.removeHandler(handler)
    logger.setLevel(level)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short intervals of warnings, in this process."""
    monkeypatch.setattr("cpn_sim_worker.session.REMINDER_SECONDS", 0.3)
