"""Live view of the simulator workers of a network: published frames, actions and plans."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeAlias, TypeVar

import rerun as rr
import rerun.blueprint as rrb
import zenoh
from google.protobuf.message import DecodeError, Message

from cpn.v1 import sim_pb2
from cpn_view.panels import ACTION_COLORS, ACTION_NAMES, PLAN_SERIES
from cpn_view.worker import Worker, entity

log = logging.getLogger(__name__)

M = TypeVar("M", bound=Message)
Subscriber: TypeAlias = "zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]"

APPLICATION = "cpn-view-live"
FRAMES, ACTIONS, PLANS = "cpn/@v1/sim/*/frame", "cpn/@v1/sim/*/action", "cpn/@v1/sim/*/plan"
ALIVE = "cpn/@v1/alive/sim/*"

QUEUE_LENGTH = 64
"""Number of waiting samples of each kind; the oldest are dropped for newer ones."""
POLL_SECONDS = 0.04
"""Interval at which the queues are emptied. Of the frames of a worker in between, the last is drawn: a simulator may be
faster than a viewer draws."""
REMINDER_SECONDS = 5.0
"""Interval of the warning that nothing is connected."""
WINDOW = rr.VisibleTimeRange(
    "log_time",
    start=rr.TimeRangeBoundary.cursor_relative(seconds=-30),
    end=rr.TimeRangeBoundary.cursor_relative(),
)
"""Shown part of the time series."""


class LiveView:
    """Watcher of the workers: zenoh's threads only enqueue, and the thread of `run` decodes and shows."""

    def __init__(self, session: zenoh.Session, stream: rr.RecordingStream) -> None:
        self._session = session
        self._stream = stream
        self._frames, self._actions, self._plans = (
            session.declare_subscriber(key, zenoh.handlers.RingChannel(QUEUE_LENGTH))
            for key in (FRAMES, ACTIONS, PLANS)
        )
        liveliness = session.liveliness()
        self._tokens = liveliness.declare_subscriber(ALIVE, zenoh.handlers.RingChannel(QUEUE_LENGTH), history=True)
        self._workers: dict[str, Worker] = {}
        self._shown: set[str] = set()
        self._stream.send_blueprint(_blueprint(self._shown))

    def run(self, stop: threading.Event, check: Callable[[], None]) -> None:
        """Shows what arrives until `stop` is set.

        Args:
            stop: Event that ends the view.
            check: Function that raises an error if the viewer has ended.
        """
        reminded = time.monotonic()
        while not stop.wait(POLL_SECONDS):
            check()
            self.poll()
            if time.monotonic() - reminded >= REMINDER_SECONDS:
                reminded = time.monotonic()
                self._remind()

    def poll(self) -> None:
        """Shows the samples that wait."""
        self._take(self._actions, sim_pb2.AppliedAction, Worker.action)
        self._take(self._frames, sim_pb2.Frame, Worker.frame)
        for worker in self._workers.values():
            worker.draw()
        self._take(self._plans, sim_pb2.TrialPlan, Worker.plan)
        # Last, so that no frame of a worker that is gone comes after its token.
        for sample in _waiting(self._tokens):
            name = str(sample.key_expr).rpartition("/")[2]
            if sample.kind == zenoh.SampleKind.PUT:
                self._worker(name)
            elif worker := self._workers.pop(name, None):
                log.info("worker %s is gone", name)
                worker.leave()

    def _take(self, subscriber: Subscriber, message_type: type[M], take: Callable[[Worker, M], None]) -> None:
        """Hands the messages that wait to their workers; faulty ones are dropped."""
        for sample in _waiting(subscriber):
            name = str(sample.key_expr).split("/")[-2]
            # Plans come from the evaluator, also after the worker's token has gone.
            if subscriber is self._plans and name not in self._workers:
                continue
            try:
                message = message_type()
                message.ParseFromString(sample.payload.to_bytes())
                take(self._worker(name), message)
            except (DecodeError, ValueError) as error:
                log.warning("dropped a message at %s: %s", sample.key_expr, error)

    def _worker(self, name: str) -> Worker:
        """Worker of a name, added if it is new."""
        if name not in self._workers:
            log.info("worker %s is here", name)
            self._workers[name] = Worker(self._stream, name)
        # Panels of workers that are gone stay until another comes, so that a restarted worker changes nothing.
        if name not in self._shown:
            self._shown = set(self._workers)
            self._stream.send_blueprint(_blueprint(self._shown))
        return self._workers[name]

    def _remind(self) -> None:
        if not (self._session.info.routers_zid() or self._session.info.peers_zid()):
            log.warning("no router or peer is connected; trying again")


def _waiting(subscriber: Subscriber) -> Iterator[zenoh.Sample]:
    """Samples that wait now, and no later ones, so that one kind does not hold up the others."""
    for _ in range(QUEUE_LENGTH):
        sample = subscriber.try_recv()
        if sample is None:
            return
        yield sample


def _blueprint(workers: set[str]) -> rrb.Blueprint:
    panels = [_panel(worker) for worker in sorted(workers)] or [rrb.TextDocumentView(name="no worker yet")]
    return rrb.Blueprint(
        rrb.Vertical(contents=panels),
        rrb.TimePanel(state="collapsed", timeline="log_time", play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
    )


def _panel(worker: str) -> rrb.Container:
    def at(*names: str) -> str:
        return entity(worker, *names)

    actions = rr.SeriesLines(names=ACTION_NAMES, colors=ACTION_COLORS)
    return rrb.Horizontal(
        rrb.Spatial2DView(origin=at("goal"), name=f"{worker}: goal"),
        # The planned path is in the space around the camera, and is drawn into its image.
        rrb.Spatial2DView(origin=at("camera"), contents=[at("camera"), at("path")], name=f"{worker}: camera"),
        rrb.Vertical(
            rrb.TextDocumentView(origin=at("episode"), name=f"{worker}: episode"),
            rrb.Tabs(
                _series(at("action"), "applied actions", actions, (-1, 1)),
                _series(at("progress"), "progress", rr.SeriesLines(names="progress"), (0, 1)),
            ),
            row_shares=[1, 2],
        ),
        rrb.Vertical(
            rrb.BarChartView(origin=at("plan", "inner_losses"), name="inner loss by update"),
            rrb.Tabs(
                *(_series(at("plan", name), name.replace("_", " "), lines) for name, lines in PLAN_SERIES.items()),
                active_tab="latent distance",
            ),
        ),
        name=worker,
    )


def _series(
    origin: str, name: str, lines: rr.SeriesLines, bounds: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """View of a series; its names are in the blueprint, since a server never drops static data."""
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_y=rrb.ScalarAxis(range=bounds) if bounds else None,
        overrides={origin: lines},
        time_ranges=WINDOW,
    )
