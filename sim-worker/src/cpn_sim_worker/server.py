"""Zenoh server of one simulator."""

from __future__ import annotations

import logging
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import TYPE_CHECKING, NoReturn, TypeVar

import zenoh
from google.protobuf.message import Message

from cpn.v1 import sim_pb2, types_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.opengl import OpenGLError, load_mujoco
from cpn_sim_worker.options import ServeConfig
from cpn_sim_worker.session import REMINDER_SECONDS, ConfigError, StoppedError, open_session, zenoh_config
from cpn_sim_worker.wire import RequestError, decode, encoding

if TYPE_CHECKING:
    from cpn_sim_worker.episode import EpisodeRunner

log = logging.getLogger(__name__)

M = TypeVar("M", bound=Message)

QUEUE_LENGTH = 8
"""Maximum number of waiting requests. A worker serves one evaluator at a time, so a longer queue is a faulty client."""

POLL_SECONDS = 0.1
"""Interval at which the signal to stop is checked while there are no requests."""

FIRST_TASK = "reach"
"""Task of the test frame that is drawn before the worker is ready."""

LEASE_SECONDS = 15.0
"""Longest time for which a dead worker's token lingers: zenoh's lease, 10 s, with a margin."""
ANSWER_SECONDS = 2.0
"""Timeout of a query for the holders of a token."""
MEETING_SECONDS = 1.5
"""Settling time after a change of connections: peers discover each other, and reconnect to a restarted router, one by
one."""


class NameTakenError(Exception):
    """Another worker has the name."""


def claim_name(
    session: zenoh.Session, worker: str, stop: threading.Event, patience_seconds: float = LEASE_SECONDS
) -> None:
    """Waits until no other worker has the name, since each of two would get a part of the requests.

    A worker that joins the network after this check goes unnoticed.

    Raises:
        NameTakenError: If another worker still has the name after `patience_seconds`.
        StoppedError: If `stop` was set meanwhile.
    """
    key = keys.sim_alive(worker)
    start = last_change = time.monotonic()
    connected: set[str] = set()
    was_connected = False
    reminded = None
    while not stop.is_set():
        replies = list(session.liveliness().get(key, timeout=ANSWER_SECONDS))
        taken = any(reply.ok is not None for reply in replies)

        now = time.monotonic()
        others = {str(other) for other in (*session.info.routers_zid(), *session.info.peers_zid())}
        if others != connected:
            connected, last_change = others, now
        was_connected = was_connected or bool(connected)
        lost = was_connected and not connected

        # The name is free only if there was no reply at all, neither late nor for lack of a connection.
        if not replies and not lost and now - last_change >= MEETING_SECONDS:
            return
        if taken and now - start >= patience_seconds:
            raise NameTakenError(
                f"worker: expected a name that no running worker has, got {worker!r}: "
                "stop the other worker, or give this one another --worker"
            )
        if taken and (reminded is None or now - reminded >= REMINDER_SECONDS):
            reminded = now
            log.warning("worker %s runs elsewhere or has just died; waiting for it to go", worker)
        stop.wait(POLL_SECONDS)
    raise StoppedError("stopped before the worker's name was free")


class SimServer:
    """Zenoh server of a worker: zenoh's threads only enqueue, and the thread of `run` simulates and answers."""

    def __init__(self, session: zenoh.Session, worker: str, episodes: EpisodeRunner) -> None:
        self._session = session
        self._worker = worker
        self._episodes = episodes
        self._queue: queue.Queue[tuple[Callable[[zenoh.Query], None], zenoh.Query]] = queue.Queue(QUEUE_LENGTH)
        # Frames are dropped for slow viewers, so that the client's answer never waits for them.
        drop = zenoh.CongestionControl.DROP
        self._frames = session.declare_publisher(
            keys.sim_frame(self._worker), encoding=encoding(sim_pb2.Frame), congestion_control=drop
        )
        self._actions = session.declare_publisher(
            keys.sim_action(self._worker), encoding=encoding(sim_pb2.AppliedAction), congestion_control=drop
        )

    def run(self, stop: threading.Event) -> None:
        """Answers requests until `stop` is set."""
        queryables = [
            self._declare(keys.sim_reset(self._worker), self._reset),
            self._declare(keys.sim_step(self._worker), self._step),
        ]
        token = self._session.liveliness().declare_token(keys.sim_alive(self._worker))
        log.info("worker %s is ready", self._worker)

        while not stop.is_set():
            try:
                handle, query = self._queue.get(timeout=POLL_SECONDS)
            except queue.Empty:
                continue
            self._answer(handle, query)

        token.undeclare()
        for queryable in queryables:
            queryable.undeclare()
        while not self._queue.empty():
            _, query = self._queue.get()
            _refuse(query, types_pb2.ERROR_CODE_UNAVAILABLE, "worker", "a running one", "one that is stopping")

    def _declare(self, key: str, handle: Callable[[zenoh.Query], None]) -> zenoh.Queryable[None]:
        def enqueue(query: zenoh.Query) -> None:
            try:
                self._queue.put_nowait((handle, query))
            except queue.Full:
                expected = f"at most {QUEUE_LENGTH} waiting requests"
                _refuse(query, types_pb2.ERROR_CODE_RESOURCE_EXHAUSTED, "queue", expected, "one more")

        return self._session.declare_queryable(key, enqueue, complete=True)

    def _answer(self, handle: Callable[[zenoh.Query], None], query: zenoh.Query) -> None:
        with query:
            try:
                handle(query)
            except RequestError as error:
                log.warning("refused a request on %s: %s", query.key_expr, error)
                _reply_error(query, error)
            except Exception as error:
                log.exception("a request on %s failed", query.key_expr)
                # The physics may have advanced without an answer to the step, so that the episode cannot go on.
                self._episodes.abandon()
                _reply_error(query, RequestError(types_pb2.ERROR_CODE_INTERNAL, "", "no fault", repr(error)))

    def _reset(self, query: zenoh.Query) -> None:
        response = self._episodes.reset(_request(query, sim_pb2.ResetRequest))
        _reply(query, keys.sim_reset(self._worker), response)
        self._publish_frame()

    def _step(self, query: zenoh.Query) -> None:
        request = _request(query, sim_pb2.StepRequest)
        response, applied = self._episodes.step(request)
        _reply(query, keys.sim_step(self._worker), response)
        if applied:
            action = sim_pb2.AppliedAction(episode_id=request.episode_id, step=request.step, action=request.action)
            self._actions.put(action.SerializeToString())
            self._publish_frame()

    def _publish_frame(self) -> None:
        if frame := self._episodes.frame():
            self._frames.put(frame.SerializeToString())


def _request(query: zenoh.Query, message_type: type[M]) -> M:
    return decode(message_type, query.payload.to_bytes() if query.payload is not None else b"")


def _reply(query: zenoh.Query, key: str, response: Message) -> None:
    query.reply(key, response.SerializeToString(), encoding=encoding(type(response)))


def _reply_error(query: zenoh.Query, error: RequestError) -> None:
    query.reply_err(error.to_proto().SerializeToString(), encoding=encoding(types_pb2.Error))


def _refuse(query: zenoh.Query, code: types_pb2.ErrorCode, field: str, expected: str, got: str) -> None:
    """Answers a query with an error."""
    with query:
        _reply_error(query, RequestError(code, field, expected, got))


def serve(config: ServeConfig) -> None:
    """Serves until SIGTERM or SIGINT."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())

    # Invalid options are reported before anything is loaded.
    zenoh_config(config.zenoh)
    with ExitStack() as network, ThreadPoolExecutor(1) as joining:

        def join() -> zenoh.Session:
            session = network.enter_context(open_session(config.zenoh, stop))
            claim_name(session, config.worker, stop)
            return session

        # Joining the network is mostly waiting, so the simulator loads meanwhile.
        joined = joining.submit(join)
        try:
            episodes = _load_episodes(config.max_steps)
            SimServer(joined.result(), config.worker, episodes).run(stop)
        except StoppedError as error:
            log.info("%s", error)
            _exit(0)
        except (ConfigError, NameTakenError, OpenGLError) as error:
            print(error, file=sys.stderr)
            _exit(1)
        finally:
            stop.set()


def _exit(status: int) -> NoReturn:
    """Exits without the interpreter's shutdown, which a thread inside `zenoh.open` could abort."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _load_episodes(max_steps: int) -> EpisodeRunner:
    """Loads the simulator and draws a test frame, so that faults of rendering show before the worker is ready.

    Raises:
        ConfigError: If an environment variable for OpenGL is invalid.
        OpenGLError: If OpenGL is missing or does not draw.
    """
    load_mujoco()
    # Imported late, since they import MuJoCo.
    from cpn_sim_worker.episode import EpisodeRunner
    from cpn_sim_worker.render import Renderer
    from cpn_sim_worker.simulator import Simulator

    simulator = Simulator(Renderer())
    simulator.reset(FIRST_TASK, seed=0)
    frame = simulator.frame()
    if frame.min() == frame.max():
        raise OpenGLError("a picture of one colour")
    return EpisodeRunner(simulator, max_steps)
