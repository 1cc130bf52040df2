"""Load generator for a planning server over HTTP: each client sends its next request after the answer."""

import asyncio
import json
import time
from pathlib import Path

import aiohttp
import numpy as np
import tyro

from cpn_bench.plan.model import PlanModel


async def drive(url: str, frames: list[bytes], clients: int, seconds: float) -> list[float]:
    """Latencies, in seconds, of the requests sent within `seconds`."""
    latencies: list[float] = []
    async with aiohttp.ClientSession(headers={"Content-Type": "application/octet-stream"}) as session:
        stop = time.perf_counter() + seconds

        async def client(number: int) -> None:
            while (start := time.perf_counter()) < stop:
                async with session.post(url, data=frames[number % len(frames)]) as response:
                    response.raise_for_status()
                    await response.json()
                latencies.append(time.perf_counter() - start)
                number += 1

        await asyncio.gather(*map(client, range(clients)))
    return latencies


def main(url: str, model: Path, clients: int, seconds: float) -> None:
    """Warms up and loads the server, and prints throughput and latencies as a line of JSON."""
    frames = [frame.tobytes() for frame in PlanModel.read(model).frames]
    asyncio.run(drive(url, frames, clients, seconds / 5))
    start = time.perf_counter()
    latencies = asyncio.run(drive(url, frames, clients, seconds))
    rate = len(latencies) / (time.perf_counter() - start)
    p50, p99 = 1e3 * np.percentile(latencies, (50, 99))
    print(json.dumps({"clients": clients, "plans_per_second": rate, "p50_ms": p50, "p99_ms": p99, "n": len(latencies)}))


if __name__ == "__main__":
    tyro.cli(main)
