"""What a frame, a step and a demonstration cost, beside Meta-World as it comes; writes runs/bench/sim.json.

make bench-sim
"""

import json
import multiprocessing
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import bootstrap
from skimage.metrics import structural_similarity

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "runs/bench/sim.json"
COMMAND = "make bench-sim"

TASK = "door-lock"
ROUNDS = 12
"""Ours and the peer take turns, so that both see the same machine."""
SSIM_FLOOR = 0.97
SSIM_STATES = 5
"""States of an expert run, evenly spread, in which the pictures of a task are compared."""
DEMONSTRATED = ("door-lock", "drawer-close", "plate-slide", "window-open")
EPISODES = 10
"""Of each demonstrated task."""
RECORDINGS = 3
"""Of the same demonstrations, by one process and by two in turns."""
FRAME_BYTES = 84 * 84 * 3
TRAINER = ROOT / "target/release/cpn-trainer"

Measure = Callable[[], float]
Build = Callable[..., dict[str, Measure]]


@dataclass(frozen=True)
class Row:
    """A comparison; a ratio above 1 says that we are better."""

    name: str
    ours: float
    peer: float
    peer_name: str
    ratio: float
    unit: str
    n: int
    command: str = COMMAND


def _rate(action: Callable[[], object], times: int) -> float:
    """How often a second an action can be done."""
    start = time.perf_counter()
    for _ in range(times):
        action()
    return times / (time.perf_counter() - start)


# What runs in a process of its own, on one core: one process can hold one renderer only.


def _ours(decimated: bool) -> dict[str, Measure]:
    from cpn_sim_worker.render import DECIMATION, Renderer
    from cpn_sim_worker.simulator import Simulator

    simulator = Simulator(Renderer(DECIMATION if decimated else None))
    simulator.reset(TASK, 0)
    action = np.array([0.1, 0.1, -0.1, 0], np.float32)

    def step() -> None:
        simulator.step(action)
        simulator.frame()

    def steps() -> float:
        simulator.reset(TASK, 0)
        return _rate(step, 100)

    return {"frames": lambda: _rate(simulator.frame, 100), "steps": steps}


def _stock() -> dict[str, Measure]:
    os.environ["MUJOCO_GL"] = "egl"
    import gymnasium
    import metaworld  # noqa: F401 - registers the environments

    env = gymnasium.make(
        "Meta-World/MT1", env_name=f"{TASK}-v3", render_mode="rgb_array", camera_name="corner4", width=84, height=84
    )
    env.reset()
    action = np.array([0.1, 0.1, -0.1, 0], np.float32)

    def step() -> None:
        env.step(action)
        env.render()

    def steps() -> float:
        env.reset()
        return _rate(step, 10)

    return {"frames": lambda: _rate(env.render, 10), "steps": steps}


def _pictures(decimated: bool) -> dict[str, NDArray[np.uint8]]:
    """Frames of every task, [SSIM_STATES, 84, 84, 3]."""
    from cpn_sim_worker.expert import solve
    from cpn_sim_worker.render import DECIMATION, Renderer
    from cpn_sim_worker.simulator import Simulator
    from cpn_sim_worker.tasks import TASKS

    simulator = Simulator(Renderer(DECIMATION if decimated else None))

    def of(task: str) -> NDArray[np.uint8]:
        count = sum(1 for _ in solve(simulator, task, 1))
        wanted = set(np.linspace(0, count - 1, SSIM_STATES).astype(int))
        return np.stack([simulator.frame() for number, _ in enumerate(solve(simulator, task, 1)) if number in wanted])

    return {task: of(task) for task in TASKS}


def _answer(connection: Connection, build: Build, arguments: tuple[bool, ...]) -> None:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    measures = build(*arguments)
    for measure in measures.values():
        measure()
    while True:
        connection.send(measures[connection.recv()]())


@contextmanager
def _process(build: Build, *arguments: bool) -> Iterator[Callable[[str], float]]:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_answer, args=(there, build, arguments))
    process.start()
    # Else `here` would wait for ever for a process that died.
    there.close()

    def ask(name: str) -> float:
        here.send(name)
        return here.recv()

    try:
        yield ask
    finally:
        process.terminate()
        process.join()


def compare(name: str, unit: str, ours: Callable[[], float], peer: Callable[[], float], peer_name: str) -> Row:
    """Takes both in turns, and prints the median ratio with its 95 % interval."""
    rates = np.array([(ours(), peer()) for _ in range(ROUNDS)])
    ratios = rates[:, 0] / rates[:, 1]
    interval = bootstrap((ratios,), np.median, rng=0).confidence_interval
    own, other = np.median(rates, axis=0)
    print(
        f"{name}: {own:.0f} {unit} ({1000 / own:.2f} ms), {peer_name} {other:.0f} ({1000 / other:.2f} ms): "
        f"{np.median(ratios):.1f} times ({interval.low:.1f} to {interval.high:.1f}, n = {ROUNDS})"
    )
    return Row(name, own, other, peer_name, float(np.median(ratios)), unit, ROUNDS)


def rates() -> list[Row]:
    """Frames, and steps with a frame each, on one core."""
    with _process(_ours, True) as ours, _process(_ours, False) as whole, _process(_stock) as stock:
        stock_name, whole_name = "stock Meta-World", "ours, undecimated"
        frames, steps = "frames per core", "steps with a frame per core"
        return [
            compare(frames, "frames/s", lambda: ours("frames"), lambda: stock("frames"), stock_name),
            compare(frames, "frames/s", lambda: ours("frames"), lambda: whole("frames"), whole_name),
            compare(steps, "steps/s", lambda: ours("steps"), lambda: stock("steps"), stock_name),
        ]


def similarity() -> Row:
    """SSIM between decimated and undecimated pictures of every task."""
    with multiprocessing.get_context("spawn").Pool(2, maxtasksperchild=1) as pool:
        ours, whole = pool.map(_pictures, (True, False), chunksize=1)
    scores = {
        task: [structural_similarity(*pair, channel_axis=-1) for pair in zip(ours[task], whole[task], strict=True)]
        for task in ours
    }
    print(f"SSIM to the undecimated picture, mean and least of {SSIM_STATES} states:")
    for task, values in scores.items():
        print(f"  {task:22s} {np.mean(values):.4f} {np.min(values):.4f}")
    means = [float(np.mean(values)) for values in scores.values()]
    print(f"  least task mean {min(means):.4f}, least picture {np.min(list(scores.values())):.4f}")
    return Row("SSIM, least task", min(means), SSIM_FLOOR, "wanted", min(means) / SSIM_FLOOR, "SSIM", len(means))


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _record(processes: int) -> tuple[float, list[dict[str, float]]]:
    """Records demonstrations through the real services; returns how many a second, and what is told of each task."""
    worker = [os.environ["CPN_SIM_WORKER"], "demonstrate", "--processes", str(processes)]
    options = ["--episodes", str(EPISODES), "--tasks", *DEMONSTRATED]
    endpoint = _free_endpoint()
    with tempfile.TemporaryDirectory() as name:
        data, checkpoints, log = (Path(name) / part for part in ("data", "checkpoints", "log"))
        serve = [TRAINER, "serve", "--dataset", data, "--checkpoints", checkpoints, "--listen", endpoint]
        with log.open("ab") as lines, subprocess.Popen(serve, stderr=lines) as recorder:
            try:
                start = time.perf_counter()
                command = [*worker, "--connect", endpoint, *options]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=lines)
                seconds = time.perf_counter() - start
            except subprocess.CalledProcessError:
                print(log.read_text(), file=sys.stderr)
                raise
            finally:
                recorder.terminate()
        verify = [TRAINER, "verify", "--dataset", data, "--json"]
        verified = subprocess.run(verify, check=True, stdout=subprocess.PIPE)
    return len(DEMONSTRATED) * EPISODES / seconds, json.loads(verified.stdout)["tasks"]


def demonstrations() -> list[Row]:
    """Time and bytes of a recorded demonstration, and what a second process brings."""
    runs = [(_record(processes=1), _record(processes=2)) for _ in range(RECORDINGS)]
    rates = np.array([[rate for rate, _ in pair] for pair in runs])
    tasks = runs[0][0][1]
    one, two = np.median(rates, axis=0)
    ratios = rates[:, 1] / rates[:, 0]
    ratio = float(np.median(ratios))
    raw = float(np.mean([task["steps_mean"] for task in tasks])) * FRAME_BYTES
    recorded = float(np.mean([task["bytes_mean"] for task in tasks]))
    count = len(DEMONSTRATED) * EPISODES
    print(
        f"demonstrations: {one:.2f} a second by one process, {two:.2f} by two, their start included: {ratio:.2f} times "
        f"({ratios.min():.2f} to {ratios.max():.2f}, n = {RECORDINGS} recordings of {count} by each)"
    )
    print(f"a recording: {recorded / 1e3:.0f} kB, its raw frames {raw / 1e3:.0f} kB, n = {count}")
    return [
        Row("demonstrations, 2 processes", two, one, "1 process", ratio, "episodes/s", RECORDINGS),
        Row("bytes of a demonstration", recorded, raw, "raw frames", raw / recorded, "bytes", count),
    ]


def _write(rows: list[Row]) -> None:
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")


def main() -> str | None:
    """Runs everything, and writes the rows after each part; returns what is wrong with them."""
    rows = rates()
    _write(rows)
    ssim = similarity()
    rows.append(ssim)
    _write(rows)
    rows += demonstrations()
    _write(rows)
    print(f"wrote {OUT.relative_to(ROOT)}")
    if ssim.ours < SSIM_FLOOR:
        return f"SSIM of the least task: expected at least {SSIM_FLOOR}, got {ssim.ours:.4f}"
    return None


if __name__ == "__main__":
    sys.exit(main())
