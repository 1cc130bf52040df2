"""Kinds of recordings: their messages as entities, and the views of these."""

# Messages are decoded by the schemas of their file, and have no static type.
# ruff: noqa: ANN401

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cpn_view import panels

Show = Callable[[rr.RecordingStream, Any], None]
"""Function that logs a message at the current time."""


@dataclass(frozen=True)
class Kind:
    """Kind of recording, told by its first message, the header."""

    application: str
    """Application in the viewer, whose recordings have one blueprint."""
    views: rrb.Container
    """Views of a recording."""
    title: Callable[[Any], str]
    """Title of a recording with this header."""
    header: Show
    """Function that logs the header, and what does not change."""
    messages: Mapping[str, Show]
    """Functions that log other messages, by type."""


def _series(stream: rr.RecordingStream, entity: str, names: list[str], *colors: tuple[int, ...]) -> None:
    stream.log(entity, rr.SeriesLines(names=names, colors=colors), static=True)


def _frame(stream: rr.RecordingStream, frame: Any) -> None:
    if frame.encoding != "rgb8":
        raise ValueError(f"frame.encoding: expected rgb8, got {frame.encoding!r}")
    stream.log("camera", panels.image(frame.data, frame.height, frame.width))


def _trial_title(trial: Any) -> str:
    return f"{trial.variation.task} {trial.variation.seed} {trial.model}"


def _trial(stream: rr.RecordingStream, trial: Any) -> None:
    stream.log("goal", panels.image(trial.goal.data, trial.goal.height, trial.goal.width), static=True)
    lines = [
        f"{trial.variation.task}, seed {trial.variation.seed}",
        f"model {trial.model} {trial.model_digest[:12]}",
        f"{trial.steps} actions, {trial.plans} plans",
    ]
    stream.log("trial", rr.TextDocument("\n".join(lines)), static=True)
    _series(stream, "plan/first_action", list(panels.ACTION_NAMES), *panels.ACTION_COLORS)
    for name, color in zip(panels.ACTION_NAMES, panels.ACTION_COLORS, strict=True):
        _series(stream, f"plan/actions/{name}", [name], color)
    for name, series in panels.PLAN_SERIES.items():
        stream.log(f"plan/{name}", series, static=True)


def _plan(stream: rr.RecordingStream, plan: Any) -> None:
    stream.log("plan/first_action", rr.Scalars(plan.first_action.values))
    # An entity for each value of an action, with its course over the horizon.
    actions = np.array([action.values for action in plan.actions])
    for name, values in zip(panels.ACTION_NAMES, actions.T, strict=False):
        stream.log(f"plan/actions/{name}", rr.Scalars(values))
    panels.plan(stream, "plan", plan)


def _trial_views() -> rrb.Container:
    return rrb.Horizontal(
        rrb.Vertical(
            rrb.Spatial2DView(origin="goal", name="goal"),
            rrb.Spatial2DView(origin="camera", name="camera"),
            rrb.TextDocumentView(origin="trial", name="trial"),
            row_shares=[3, 3, 1.3],
        ),
        rrb.Vertical(
            rrb.TimeSeriesView(origin="plan/first_action", name="action to apply"),
            rrb.TimeSeriesView(
                origin="plan/actions",
                name="planned actions, one line for each step of the horizon",
                plot_legend=rrb.PlotLegend(visible=False),
            ),
            rrb.TimeSeriesView(origin="plan/latent_distance", name="latent distance to the goal"),
        ),
        rrb.Vertical(
            rrb.TimeSeriesView(origin="plan/inner_loss", name="inner loss"),
            rrb.BarChartView(origin="plan/inner_losses", name="inner loss by update, of the current plan"),
            rrb.TimeSeriesView(origin="plan/times_ms", name="times of the stages, ms"),
        ),
        column_shares=[2, 3, 3],
    )


def _demonstration_title(episode: Any) -> str:
    return f"{episode.variation.task} {episode.variation.seed}"


def _demonstration(stream: rr.RecordingStream, episode: Any) -> None:
    lines = [
        f"{episode.variation.task}, seed {episode.variation.seed}",
        f"{episode.steps} steps, at {episode.control_hz:g} Hz",
    ]
    stream.log("demonstration", rr.TextDocument("\n".join(lines)), static=True)
    _series(stream, "action", list(panels.ACTION_NAMES), *panels.ACTION_COLORS)
    _series(stream, "reward", ["reward"], panels.BLUE)
    _series(stream, "success", ["success"], panels.GREEN)


def _step(stream: rr.RecordingStream, step: Any) -> None:
    if step.HasField("action"):
        stream.log("action", rr.Scalars(step.action.values))
    stream.log("reward", rr.Scalars(step.reward))
    stream.log("success", rr.Scalars(step.success))


def _demonstration_views() -> rrb.Container:
    return rrb.Horizontal(
        rrb.Vertical(
            rrb.Spatial2DView(origin="camera", name="camera"),
            rrb.TextDocumentView(origin="demonstration", name="demonstration"),
            row_shares=[4, 1],
        ),
        rrb.Vertical(
            rrb.TimeSeriesView(origin="action", name="actions"),
            rrb.TimeSeriesView(origin="reward", name="reward"),
            rrb.TimeSeriesView(origin="success", name="success"),
            row_shares=[3, 2, 1],
        ),
        column_shares=[2, 3],
    )


CAMERA = {"foxglove.RawImage": _frame}

KINDS = {
    "cpn.v1.RecordedTrial": Kind(
        "cpn-view-trials", _trial_views(), _trial_title, _trial, CAMERA | {"cpn.v1.PlanResponse": _plan}
    ),
    "cpn.v1.RecordedEpisode": Kind(
        "cpn-view-demonstrations",
        _demonstration_views(),
        _demonstration_title,
        _demonstration,
        CAMERA | {"cpn.v1.RecordedStep": _step},
    ),
}
"""Kinds by the type of their header."""
