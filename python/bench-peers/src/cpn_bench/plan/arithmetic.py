"""Throughput of large float32 matrix products on this machine, as a line of JSON."""

import json
import time

import torch
import tyro

SIZE, TRIES = 1024, 20


def main(threads: int) -> None:
    """Prints the operations a second of the fastest try."""
    torch.set_num_threads(threads)
    left, right = torch.rand(2, SIZE, SIZE)
    out = torch.empty(SIZE, SIZE)

    def seconds() -> float:
        start = time.perf_counter()
        torch.mm(left, right, out=out)
        return time.perf_counter() - start

    best = min(seconds() for _ in range(TRIES))
    print(json.dumps({"operations_per_second": 2 * SIZE**3 / best}))


if __name__ == "__main__":
    tyro.cli(main)
