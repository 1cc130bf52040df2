"""Protocol of a training contender: numbers of steps on standard input, their times as lines of JSON on output."""

import json
import sys
import time
from collections.abc import Callable
from typing import Protocol

MAX_GRADIENT_NORM = 10.0
LEARNING_RATE = 1e-3
WARM_UP_STEPS = 5


class Contender(Protocol):
    """Model with its optimiser and its batches."""

    def step(self, number: int) -> Callable[[], float]:
        """Starts a training step; the returned function waits for it and returns the loss before the update."""
        ...


def serve(contender: Contender) -> None:
    """Compiles and warms up, prints the first loss, then trains on request until standard input ends."""
    first = contender.step(0)()
    for number in range(1, WARM_UP_STEPS):
        contender.step(number)()
    print(json.dumps({"ready": True, "loss": first}), flush=True)
    number = WARM_UP_STEPS
    for line in sys.stdin:
        start = time.perf_counter()
        for _ in range(int(line) - 1):
            contender.step(number)
            number += 1
        loss = contender.step(number)()
        number += 1
        print(json.dumps({"seconds": time.perf_counter() - start, "loss": loss}), flush=True)
