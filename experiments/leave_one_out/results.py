"""Results of an experiment, as the workflow leaves them: RESULTS/TASK/METHOD-SEED.json."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

Cell = dict[str, Any]  # A result, as jobs.py wrote it.

HERE = Path(__file__).resolve().parent


class ResultsError(ValueError):
    """Results that do not belong together."""


@dataclass(frozen=True)
class Results:
    """Results of an experiment, complete or not."""

    cells: dict[tuple[str, str], list[Cell]]
    """Of each task and method, in the order of their training seeds. METHOD-uN is the method planned with N updates."""
    variations: dict[str, list[int]]
    """Seeds of the variations of each task, the same for all methods."""
    solved_at_reset: dict[str, list[int]]
    """Seeds of those that were refused as trials: the task was solved before any action."""

    @classmethod
    def read(cls, folder: Path) -> "Results":
        """Reads a folder of results.

        Raises:
            ResultsError: If there are none, or those of a task are of different variations.
        """
        cells: dict[tuple[str, str], list[Cell]] = {}
        variations: dict[str, list[int]] = {}
        solved_at_reset: dict[str, list[int]] = {}
        for path in sorted(folder.glob("*/*-*.json")):
            task, (name, _, seed) = path.parent.name, path.stem.rpartition("-")
            cell = json.loads(path.read_text()) | {"seed": int(seed)}
            expected = variations.setdefault(task, cell["seeds"])
            if cell["seeds"] != expected:
                raise ResultsError(f"{path}: expected the variations {expected}, got {cell['seeds']}")
            solved_at_reset[task] = cell["solved_at_reset"]
            cells.setdefault((task, name), []).append(cell)
        if not cells:
            raise ResultsError(f"{folder}: expected results of at least one cell, got none")
        return cls(cells, variations, solved_at_reset)

    @property
    def tasks(self) -> list[str]:
        """Tasks with a result."""
        return sorted(self.variations)

    @property
    def methods(self) -> list[str]:
        """Methods with a result, in the order of methods.yaml."""
        found = {method for _, method in self.cells}
        return [method for method in yaml.safe_load((HERE / "methods.yaml").read_text())["recipes"] if method in found]

    @property
    def trained(self) -> list[str]:
        """Trained methods, in the order of `methods`."""
        return [name for name in self.methods if any(cell["trained"] for cell in self.of(name))]

    def of(self, method: str) -> list[Cell]:
        """Results of a method, by task and training seed."""
        return [cell for task in self.tasks for cell in self.cells.get((task, method), [])]

    def updates(self, method: str) -> dict[int, str]:
        """Names of a method's results by their number of inner-loop updates U, that of its training among them."""
        found = {}
        for name in sorted({name for _, name in self.cells}):
            cell = self.of(name)[0]
            if cell["cell"]["method"] == method:
                found[cell["cell"]["options"].get("updates", cell["trained"]["updates"])] = name
        return dict(sorted(found.items()))

    def outcomes(self, task: str, method: str) -> NDArray[np.float64]:
        """[training seeds, variations]: 1 for a success."""
        return np.array([cell["successes"] for cell in self.cells[task, method]], np.float64)

    def common(self, *methods: str) -> list[str]:
        """Tasks with results of all these methods."""
        return [task for task in self.tasks if all((task, method) in self.cells for method in methods)]
