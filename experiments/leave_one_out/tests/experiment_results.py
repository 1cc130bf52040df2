"""Small results, as jobs.py writes them."""

import json
from pathlib import Path

SEEDS = [1_000_000, 1_000_001, 1_000_002, 1_000_003]
CONTROLS = {"random", "no-op", "oracle"}


def write(
    folder: Path,
    task: str,
    method: str,
    successes: list[int],
    seed: int = 0,
    seeds: list[int] = SEEDS,
    updates: int | None = None,
) -> None:
    """The result of a method at a task; with `updates`, of its weights planned otherwise."""
    trained = {
        "cell": {"code": "c0de"},
        "weights": "5a" * 32,
        "demonstrations": 2,
        "data_digest": "da" * 32,
        "epochs": 5,
        "horizon": 5 if method in {"upn", "cpn"} else 1,
        "updates": 1 if method in {"upn", "cpn"} else 0,
        "loss": 0.05,
        "samples": 2000,
        "seconds": 20.0,
        "curve": [[128, 1.0], [1024, 0.1], [2000, 0.05]],
    }
    distances = {"success": [[0, 4.0, 1]] if any(successes) else [], "failure": [[0, 5.0, 2], [5, 4.5, 2]]}
    result = {
        "cell": {
            "fold": task,
            "method": method,
            "options": {} if updates is None else {"updates": updates},
            "training": None if method in CONTROLS else "cell",
            "code": "c0de",
        },
        "weights": trained["weights"],
        "trained": None if method in CONTROLS else trained,
        "seeds": seeds,
        "successes": successes,
        "steps": [10, 20, 30, 40],
        "best_progress": [0.1, 0.2, 0.3, 1.0],
        "solved_at_reset": [],
        "plan_ms": 0.2,
        "encode_ms": 0.1,
        "latent_distance": {"success": [], "failure": []} if method in CONTROLS else distances,
        "processor": "a processor",
    }
    name = method if updates is None else f"{method}-u{updates}"
    (folder / task).mkdir(parents=True, exist_ok=True)
    (folder / task / f"{name}-{seed}.json").write_text(json.dumps(result))
