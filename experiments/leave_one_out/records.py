"""Parts of a job's records that its result keeps: of the trainer's journal, and of the evaluator's trials."""

import json
from pathlib import Path
from typing import Any

Record = dict[str, Any]  # JSON, as the services wrote it.

CURVE_POINTS = 50
DISTANCE_STEPS = 5
"""Steps between two points of the latent distance."""


def training(journal: Path, checkpoint: Path) -> Record:
    """A training run: its cost, its settings, and its learning curve as [samples, loss] at no more than 50 steps."""
    entries = [json.loads(line) for line in journal.read_text().splitlines()]
    with checkpoint.open("rb") as file:
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    # docs/checkpoint-format.md has the fields.
    origin = json.loads(header["__metadata__"]["cpn"])

    last = entries[-1]
    return {
        "data_digest": origin["provenance"]["data_digest"],
        "epochs": origin["provenance"]["training"]["epochs"],
        "horizon": origin["model"]["horizon"],
        "updates": origin["model"]["updates"],
        "loss": last["loss"],
        "samples": last["samples"],
        # By the rate of the last process: a run that was interrupted has gaps.
        "seconds": round(last["samples"] / last["samples_per_second"], 1),
        "curve": [[entry["samples"], float(f"{entry['loss']:.4g}")] for entry in _spread(entries)],
    }


def _spread(entries: list[Record]) -> list[Record]:
    """At most `CURVE_POINTS` entries, evenly spread, the first and the last among them."""
    if len(entries) <= CURVE_POINTS:
        return entries
    return [entries[k * (len(entries) - 1) // (CURVE_POINTS - 1)] for k in range(CURVE_POINTS)]


def trials(records: list[Record]) -> Record:
    """The trials of a method at a task, in the order of their seeds."""
    attempts = [trial for trial in records if trial["outcome"] in ("success", "failure")]
    return {
        "seeds": [trial["seed"] for trial in attempts],
        "successes": [int(trial["outcome"] == "success") for trial in attempts],
        "steps": [trial["episode"]["steps"] for trial in attempts],
        "best_progress": [_best_progress(trial["episode"]) for trial in attempts],
        "solved_at_reset": [trial["seed"] for trial in records if trial["outcome"] == "solved-at-reset"],
        "plan_ms": _mean_ms(attempts, "plan_seconds"),
        "encode_ms": _mean_ms(attempts, "encode_seconds"),
        "latent_distance": {outcome: _distances(attempts, outcome) for outcome in ("success", "failure")},
    }


def _mean_ms(attempts: list[Record], stage: str) -> float:
    """Mean time of a stage over all plans, in milliseconds."""
    episodes = [trial["episode"] for trial in attempts]
    total = sum(episode["steps"] * episode["mean_times"][stage] for episode in episodes)
    return round(1e3 * total / max(1, sum(episode["steps"] for episode in episodes)), 3)


def _best_progress(episode: Record) -> float | None:
    """Highest progress of an episode; none where the simulator does not measure it."""
    progress = episode.get("progress")
    return round(max(progress), 3) if progress else None


def _distances(attempts: list[Record], outcome: str) -> list[list[float]]:
    """Latent distance to the goal: [step, mean, episodes that last so long]; none without an embedding."""
    by_step: dict[int, list[float]] = {}
    for episode in (trial["episode"] for trial in attempts if trial["outcome"] == outcome):
        distances = episode["latent_distances"]
        # The record has no steps where there was a plan before every one.
        for step, distance in zip(episode.get("plan_steps") or range(len(distances)), distances, strict=True):
            if step % DISTANCE_STEPS == 0 and distance is not None:
                by_step.setdefault(step, []).append(distance)
    return [[step, round(sum(values) / len(values), 4), len(values)] for step, values in sorted(by_step.items())]
