"""Protocol of a planning contender: numbers of batches on standard input, their times as lines of JSON on output."""

import json
import sys
import time
from collections.abc import Sequence
from typing import Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from cpn_bench.plan.model import PlanModel

WARM_UP_BATCHES = 5
Goals = TypeVar("Goals")
Plans: TypeAlias = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Actions `[B, H, A]`, and inner losses `[U + 1, B]` before each update and after the last."""


class Contender(Protocol[Goals]):
    """Planner with embedded goals."""

    def embed(self, goals: NDArray[np.uint8]) -> Goals:
        """Embeddings of goals `[B, 84, 84, 3]`, in the planner's representation."""
        ...

    def plan(self, observations: NDArray[np.uint8], goals: Goals) -> Plans:
        """Plans from observations `[B, 84, 84, 3]` to embedded goals."""
        ...


def serve(contender: Contender[Goals], data: PlanModel, batch: int) -> None:
    """Compiles and warms up, prints the first plan, then plans on request until standard input ends."""
    starts = range(0, len(data.frames), batch)
    batches: Sequence[tuple[NDArray[np.uint8], Goals]] = [
        (data.frames[start : start + batch], contender.embed(data.goals[start : start + batch])) for start in starts
    ]
    first = contender.plan(*batches[0])[0][0]
    for number in range(1, WARM_UP_BATCHES):
        contender.plan(*batches[number % len(batches)])
    print(json.dumps({"ready": True, "actions": first.tolist()}), flush=True)
    number = WARM_UP_BATCHES
    for line in sys.stdin:
        start = time.perf_counter()
        for _ in range(int(line)):
            contender.plan(*batches[number % len(batches)])
            number += 1
        print(json.dumps({"seconds": time.perf_counter() - start}), flush=True)
