import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from cpn_view.session import ZenohConfig, open_session
from tests.support import Network, free_port, listen


@pytest.fixture(scope="session", autouse=True)
def _no_options_from_outside() -> Iterator[None]:
    """Unsets the environment variables of options, also for the processes under test."""
    with pytest.MonkeyPatch.context() as patch:
        for variable in [name for name in os.environ if name.startswith("CPN_") or name == "ZENOH_CONFIG"]:
            if variable != "CPN_SIM_WORKER":
                patch.delenv(variable)
        yield


@pytest.fixture
def network() -> Iterator[Network]:
    """Peer that publishes as workers do."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with listen(endpoint) as session:
        yield Network(endpoint, session)


@pytest.fixture
def watcher(network: Network) -> Iterator[zenoh.Session]:
    """Session of a watcher in the network."""
    with open_session(ZenohConfig(connect=network.endpoint)) as session:
        yield session


@pytest.fixture
def rrd(tmp_path: Path) -> Path:
    """File for what is logged."""
    return tmp_path / "view.rrd"
