from collections.abc import Iterator
from contextlib import ExitStack

import pytest
import zenoh

from cpn.v1 import demonstration_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.session import UnavailableError, ZenohConfig, ask, open_session
from tests.support import collect, wait_for_sample


@pytest.fixture
def peers(session: zenoh.Session, endpoint: str) -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """Two peers that know nothing but the endpoint of a third."""
    with ExitStack() as stack:
        config = ZenohConfig(connect=(endpoint,))
        yield stack.enter_context(open_session(config)), stack.enter_context(open_session(config))


def test_peers_reach_each_other_through_a_shared_endpoint(peers: tuple[zenoh.Session, zenoh.Session]) -> None:
    one, other = peers
    alive = other.liveliness().declare_subscriber(keys.planner_alive("p0"), collect(), history=True)
    token = one.liveliness().declare_token(keys.planner_alive("p0"))
    wait_for_sample(alive, zenoh.SampleKind.PUT)
    token.undeclare()
    wait_for_sample(alive, zenoh.SampleKind.DELETE)
    alive.undeclare()


def test_nobody_behind_a_key_is_unavailable(session: zenoh.Session) -> None:
    with pytest.raises(UnavailableError, match="nobody/commit"):
        ask(
            session,
            keys.demonstration_commit("nobody"),
            demonstration_pb2.CommitEpisodeRequest(),
            demonstration_pb2.CommitEpisodeResponse,
            0.5,
        )
