"""Live view of the simulator workers of a network, of the frames and actions that they publish."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import TypeVar

import rerun as rr
import rerun.blueprint as rrb
import zenoh
from google.protobuf.message import DecodeError, Message

from cpn.v1 import sim_pb2
from cpn_view.panels import ACTION_COLORS, ACTION_NAMES, image_of

log = logging.getLogger(__name__)

M = TypeVar("M", bound=Message)

APPLICATION = "cpn-view-live"
FRAMES, ACTIONS, ALIVE = "cpn/@v1/sim/*/frame", "cpn/@v1/sim/*/action", "cpn/@v1/alive/sim/*"

QUEUE_LENGTH = 64
"""Number of waiting samples of each kind; the oldest are dropped for newer ones."""
POLL_SECONDS = 0.04
"""Interval at which the queues are emptied. Of the frames of a worker in between, the last is shown: a simulator may be
faster than a viewer draws."""
REMINDER_SECONDS = 5.0
"""Interval of the warning that nothing is connected."""
WINDOW = rr.VisibleTimeRange(
    "log_time",
    start=rr.TimeRangeBoundary.cursor_relative(seconds=-30),
    end=rr.TimeRangeBoundary.cursor_relative(),
)
"""Shown part of the time series."""
MAX_ROWS = 2
"""Most workers with one panel in a row."""


class LiveView:
    """Watcher of the workers: zenoh's threads only enqueue, and the thread of `run` decodes and shows."""

    def __init__(self, session: zenoh.Session, stream: rr.RecordingStream) -> None:
        self._session = session
        self._stream = stream
        self._frames = session.declare_subscriber(FRAMES, zenoh.handlers.RingChannel(QUEUE_LENGTH))
        self._actions = session.declare_subscriber(ACTIONS, zenoh.handlers.RingChannel(QUEUE_LENGTH))
        liveliness = session.liveliness()
        self._tokens = liveliness.declare_subscriber(ALIVE, zenoh.handlers.RingChannel(QUEUE_LENGTH), history=True)
        self._alive: set[str] = set()
        self._shown: set[str] = set()
        self._episodes: dict[str, str] = {}
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
        for sample in _waiting(self._actions):
            self._show(sample, sim_pb2.AppliedAction, self._action)
        latest = {str(sample.key_expr): sample for sample in _waiting(self._frames)}
        for sample in latest.values():
            self._show(sample, sim_pb2.Frame, self._frame)
        # Last, so that no frame of a worker that is gone comes after its token.
        for sample in _waiting(self._tokens):
            worker = str(sample.key_expr).rpartition("/")[2]
            if sample.kind == zenoh.SampleKind.PUT:
                self._come(worker)
            else:
                self._go(worker)

    def _come(self, worker: str) -> None:
        if worker not in self._alive:
            log.info("worker %s is here", worker)
            self._alive.add(worker)
        # Panels of workers that are gone stay until another comes, so that a restarted worker changes nothing.
        if worker not in self._shown:
            self._shown = set(self._alive)
            self._stream.send_blueprint(_blueprint(self._shown))

    def _go(self, worker: str) -> None:
        log.info("worker %s is gone", worker)
        self._alive.discard(worker)
        self._episodes.pop(worker, None)
        self._stream.log(_entity(worker, "episode"), rr.TextDocument("The worker is gone."))

    def _show(self, sample: zenoh.Sample, message_type: type[M], show: Callable[[str, M], None]) -> None:
        worker = str(sample.key_expr).split("/")[-2]
        try:
            message = message_type()
            message.ParseFromString(sample.payload.to_bytes())
            self._come(worker)
            show(worker, message)
        except (DecodeError, ValueError) as error:
            log.warning("dropped a message at %s: %s", sample.key_expr, error)

    def _action(self, worker: str, action: sim_pb2.AppliedAction) -> None:
        if self._episodes.get(worker) != action.episode_id:
            self._episodes[worker] = action.episode_id
            # A gap between the lines of two episodes.
            self._stream.log(_entity(worker, "action"), rr.Clear(recursive=False))
        self._stream.log(_entity(worker, "action"), rr.Scalars(action.action.values))

    def _frame(self, worker: str, frame: sim_pb2.Frame) -> None:
        self._stream.log(_entity(worker, "camera"), image_of(frame.image))
        self._stream.log(_entity(worker, "episode"), rr.TextDocument(f"{frame.episode_id}, step {frame.step}"))

    def _remind(self) -> None:
        if not (self._session.info.routers_zid() or self._session.info.peers_zid()):
            log.warning("no router or peer is connected; trying again")


def _waiting(subscriber: "zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]") -> Iterator[zenoh.Sample]:
    """Samples that wait now, and no later ones, so that one kind does not hold up the others."""
    for _ in range(QUEUE_LENGTH):
        sample = subscriber.try_recv()
        if sample is None:
            return
        yield sample


def _entity(worker: str, *names: str) -> str:
    return rr.new_entity_path(["workers", worker, *names])


def _blueprint(workers: set[str]) -> rrb.Blueprint:
    panels = [_panel(worker) for worker in sorted(workers)] or [rrb.TextDocumentView(name="no worker yet")]
    return rrb.Blueprint(
        rrb.Grid(contents=panels, grid_columns=1 if len(panels) <= MAX_ROWS else 2),
        rrb.TimePanel(state="collapsed", timeline="log_time", play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
    )


def _panel(worker: str) -> rrb.Container:
    action = _entity(worker, "action")
    return rrb.Horizontal(
        rrb.Spatial2DView(origin=_entity(worker, "camera"), name=f"{worker}: camera"),
        rrb.Vertical(
            rrb.TextDocumentView(origin=_entity(worker, "episode"), name=f"{worker}: episode"),
            rrb.TimeSeriesView(
                origin=action,
                name=f"{worker}: applied actions",
                axis_y=rrb.ScalarAxis(range=(-1, 1)),
                # In the blueprint, since a server never drops static data.
                overrides={action: rr.SeriesLines(names=ACTION_NAMES, colors=ACTION_COLORS)},
                time_ranges=WINDOW,
            ),
            row_shares=[1, 4],
        ),
        column_shares=[1, 2],
        name=worker,
    )
