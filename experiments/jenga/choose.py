"""The paper's rule: the horizon and the number of updates whose plans are predicted to end nearest to their targets.

Measured on the trained starts and targets alone.
"""

import json
from pathlib import Path

import numpy as np
from planning import Planner, along, demonstrations, network

from cpn_sim_worker import keys


def choose(
    endpoint: str, planner_name: str, out: Path, episodes: list[str], models: list[str], diverged: list[str]
) -> tuple[int, int]:
    """Writes the table, with the models whose training diverged, and answers horizon and updates.

    Each model is named `h<H>-u<U>`.
    """
    rows: list[dict[str, float]] = []
    with network(endpoint, keys.planner_alive(planner_name)) as session:
        recorded = demonstrations(session, episodes)
        planner, length = Planner(session, planner_name), max(len(demonstration.actions) for demonstration in recorded)
        for model in models:
            horizon, updates = (int(part[1:]) for part in model.split("-"))
            ends = [
                along(d.positions[0], planner.trajectory(model, d.positions[0], d.goal, length))[-1] - d.goal
                for d in recorded
            ]
            deviation_cm = float(100 * np.linalg.norm(ends, axis=1).mean())
            rows.append({"horizon": horizon, "updates": updates, "deviation_cm": deviation_cm, "n": len(ends)})
            print(f"H = {horizon:2}, U = {updates}: {deviation_cm:.2f} cm from the target")
    best = min(rows, key=lambda row: row["deviation_cm"])
    out.write_text(json.dumps({"length": length, "grid": rows, "diverged": diverged, "chosen": best}, indent=2) + "\n")
    return int(best["horizon"]), int(best["updates"])
