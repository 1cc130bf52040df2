import json
from pathlib import Path

import pytest
from cells import ROOT
from records import training, trials

CHECKPOINT = ROOT / "models/cpn.safetensors"


def journal(path: Path, entries: int) -> Path:
    """A trainer's journal, of one line each hundred samples."""
    rows = [{"samples": 100 * k, "loss": 1 / k, "samples_per_second": 50} for k in range(1, entries + 1)]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


@pytest.mark.parametrize("entries", [1, 50, 51, 1000])
def test_a_learning_curve_has_its_ends_and_at_most_fifty_points(tmp_path: Path, entries: int) -> None:
    found = training(journal(tmp_path / "progress.jsonl", entries), CHECKPOINT)
    assert len(found["curve"]) == min(entries, 50)
    assert found["curve"][0] == [100, 1.0]
    assert found["curve"][-1] == [100 * entries, pytest.approx(1 / entries, rel=1e-3)]
    assert (found["samples"], found["seconds"]) == (100 * entries, 2 * entries)
    # Of the shipped checkpoint.
    assert (found["epochs"], found["horizon"], found["updates"]) == (5, 5, 1)


def trial(seed: int, outcome: str, distances: list[float | None], plan_steps: list[int] | None = None) -> dict:
    times = {"plan_seconds": 2e-4, "encode_seconds": 1e-4}
    episode = {
        "steps": len(distances),
        "progress": [0.0, 0.5, 0.25],
        "latent_distances": distances,
        "mean_times": times,
    }
    if plan_steps:
        episode["plan_steps"] = plan_steps
    return {"seed": seed, "outcome": outcome, "episode": episode}


def test_latent_distances_are_of_successes_and_failures_apart_at_each_fifth_step() -> None:
    found = trials(
        [
            trial(1, "failure", [4.0, 9.0, 9.0, 9.0, 9.0, 2.0]),
            trial(2, "failure", [2.0, 9.0]),
            trial(3, "failure", [None, 9.0]),
            trial(4, "success", [6.0, 3.0], plan_steps=[0, 5]),
            {"seed": 5, "outcome": "solved-at-reset", "episode": None},
        ]
    )
    assert found["latent_distance"] == {"success": [[0, 6.0, 1], [5, 3.0, 1]], "failure": [[0, 3.0, 2], [5, 2.0, 1]]}
    assert (found["seeds"], found["successes"], found["solved_at_reset"]) == ([1, 2, 3, 4], [0, 0, 0, 1], [5])
    assert found["best_progress"] == [0.5] * 4
    assert (found["plan_ms"], found["encode_ms"]) == (0.2, 0.1)


def test_a_method_without_an_embedding_has_no_latent_distance() -> None:
    assert trials([trial(1, "failure", [])])["latent_distance"] == {"success": [], "failure": []}
