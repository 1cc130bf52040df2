"""Figures of the stack: throughput, start-up, recovery, and what mutual TLS costs. Rows go to runs/bench/stack.json."""

import argparse
import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.stats import bootstrap

from cpn_stack import docker as engine
from cpn_stack.docker import docker, inspect, logs, read_folder, wait_until, write_file
from cpn_stack.metrics import Metrics
from cpn_stack.recovery import kill_planner, kill_router, plans
from cpn_stack.stack import ROOT, USER, Stack

COMMAND = "make bench-stack"
TASKS, MODELS = "drawer-close,plate-slide", "cpn,te-bc"
WORKERS = (1, 2, 4)
RECOVERY_GOAL_SECONDS = 5.0
BLOCK = 20
"""Plans over either network whose medians make one ratio."""


@dataclass(frozen=True)
class Row:
    """A figure beside a peer's, if it has one."""

    name: str
    ours: float
    peer: float | None
    peer_name: str | None
    ratio: float | None
    unit: str
    n: int
    command: str = COMMAND


@dataclass(frozen=True)
class Effort:
    """How much is measured."""

    trials: int
    rounds: int
    start_ups: int
    router_kills: int
    planner_kills: int
    plans: int


FULL = Effort(trials=6, rounds=2, start_ups=3, router_kills=50, planner_kills=20, plans=3000)
QUICK = Effort(trials=2, rounds=1, start_ups=1, router_kills=3, planner_kills=2, plans=400)


@contextmanager
def metrics_of(stack: Stack) -> Iterator[list[Metrics]]:
    """The planners' metrics."""
    with TemporaryDirectory() as folder:
        certificates = stack.certificates("viewer", Path(folder))
        yield [Metrics(stack.ports[f"CPN_TEST_PORT_METRICS_{number}"], certificates) for number in (0, 1)]


def spread(name: str, seconds: Sequence[float], goal: float | None = None) -> list[Row]:
    """Rows of a distribution of times: its median and its longest, beside a goal's if there is one."""
    rows = []
    for what, value in (("p50", float(np.median(seconds))), ("max", float(np.max(seconds)))):
        ratio = None if goal is None else goal / value
        rows.append(Row(f"{name}, {what}", value, goal, None if goal is None else "goal", ratio, "s", len(seconds)))
    print(f"{name}: p50 {rows[0].ours:.2f} s, max {rows[1].ours:.2f} s, n = {len(seconds)}", flush=True)
    return rows


def start_up(effort: Effort) -> list[Row]:
    """Times from `up`, with images and without volumes, until every service is up and until the first plan."""
    up: list[float] = []
    first: list[float] = []
    for _ in range(effort.start_ups):
        stack = Stack()
        stack.environment |= {"CPN_EVAL_TASKS": TASKS, "CPN_EVAL_MODELS": MODELS, "CPN_EVAL_TRIALS": "1"}
        try:
            start = time.monotonic()
            stack.compose("up", "--detach", "--no-build")
            up.append(time.monotonic() - start)
            with metrics_of(stack) as metrics:
                wait_until("the first plan", lambda sources=metrics: plans(sources) > 0, pause_seconds=0.05)
            first.append(time.monotonic() - start)
        finally:
            stack.down()
    return [*spread("start-up, from up until it returns", up), *spread("start-up, from up until the first plan", first)]


def _seconds(container: str) -> float:
    begin, end = (
        datetime.fromisoformat(inspect(container, f".State.{field}At")[:26].rstrip("Z") + "+00:00")
        for field in ("Started", "Finished")
    )
    return (end - begin).total_seconds()


def throughput(stack: Stack, effort: Effort) -> list[Row]:
    """Trials an hour by workers, in turns there and back."""
    rates: dict[int, list[float]] = {workers: [] for workers in WORKERS}
    for number in range(effort.rounds):
        for workers in WORKERS[:: -1 if number % 2 else 1]:
            stack.up("sim-worker", workers=workers)
            for worker in stack.containers("sim-worker"):
                wait_until("a worker is ready", lambda name=worker: "is ready" in logs(name))
            evaluation = stack.evaluate(
                f"throughput-{workers}-{number}", tasks=TASKS, models=MODELS, trials=effort.trials, workers=workers
            )
            if evaluation.wait() != 0:
                raise RuntimeError(evaluation.log())
            rates[workers].append(4 * effort.trials / _seconds(evaluation.container) * 3600)
    rows = []
    for workers, of_workers in rates.items():
        rate, one = float(np.mean(of_workers)), float(np.mean(rates[1]))
        told = ", ".join(f"{value:.0f}" for value in of_workers)
        print(f"{workers} workers, {os.cpu_count()} cores: {rate:.0f} trials an hour ({told})", flush=True)
        trials = 4 * effort.trials * len(of_workers)
        rows.append(Row(f"trials, {workers} workers", rate, one, "1 worker", rate / one, "1/h", trials))
    return rows


def recovery(stack: Stack, effort: Effort) -> list[Row]:
    """Times from the start of a router or planner that was killed until the evaluation goes on."""
    stack.up()
    with metrics_of(stack) as metrics:
        routed = stack.evaluate("router-kills", tasks=TASKS, models=MODELS, trials=500)
        rows = spread(
            "recovery, router killed and started",
            [kill_router(stack, metrics) for _ in range(effort.router_kills)],
            RECOVERY_GOAL_SECONDS,
        )
        docker("rm", "--force", routed.container)
        planned = stack.evaluate("planner-kills", tasks=TASKS, models=MODELS, trials=500, planners="planner-0")
        rows += spread(
            "recovery, only planner killed and started",
            [kill_planner(stack, metrics[0], "planner-0") for _ in range(effort.planner_kills)],
            RECOVERY_GOAL_SECONDS,
        )
        docker("rm", "--force", planned.container)
    return rows


def plain_and_tls_router(stack: Stack) -> str:
    """Starts a router as that of the stack, which also listens in plain text; its name in the network."""
    name = f"{stack.project}-bench-router"
    config = json.loads(read_folder(stack.container("router"), "/certificates/router")["router.json5"])
    config["listen"]["endpoints"].append("tcp/0.0.0.0:7448")
    config["transport"]["link"]["protocols"].append("tcp")
    # Access control works for either: nobody has a certificate in plain text, so that everybody may what routers may.
    config["access_control"]["subjects"].append({"id": "plain", "link_protocols": ["tcp"]})
    config["access_control"]["policies"].append({"rules": ["router"], "subjects": ["plain"]})
    image = inspect(stack.container("router"), ".Config.Image")
    volumes = [f"{stack.project}_certificates-router:/certificates/router:ro", f"{name}:/bench"]
    options = ["--network", f"{stack.project}_stack", "--network-alias", "bench-router"]
    options += [f"--volume={volume}" for volume in volumes]
    options += ["--user", f"{USER}:{USER}", "--entrypoint", "/zenohd"]
    docker("create", "--name", name, *options, image, "--config", "/bench/router.json5", "--no-multicast-scouting")
    write_file(name, "/bench", "router.json5", json.dumps(config).encode(), USER)
    docker("start", name)
    return name


def cost_of_tls(stack: Stack, effort: Effort) -> list[Row]:
    """A plan's round trip over mutual TLS and over TCP, through the same router, in turns, by one client."""
    stack.up("router", "planner-0")
    router = plain_and_tls_router(stack)
    networks = {"tls": ("tls/bench-router:7447", "bench-tls"), "tcp": ("tcp/bench-router:7448", "bench-tcp")}
    try:
        for endpoint, planner in networks.values():
            options = ["-e", f"CPN_PLANNER_NAME={planner}", "-e", f"CPN_CONNECT={endpoint}"]
            container = stack.run("planner-0", options=options)
            wait_until("a planner is ready", lambda name=container: "planner is ready" in logs(name))
        client = ["run", "--rm", "--interactive", f"--network={stack.project}_stack", "--entrypoint=python"]
        client += [f"--volume={stack.project}_certificates-client:/certificates:ro", "--env=CPN_MODE=client"]
        for variable, file in (("CA", "ca"), ("CERTIFICATE", "certificate"), ("PRIVATE_KEY", "private-key")):
            client.append(f"--env=CPN_TLS_{variable}=/certificates/{file}.pem")
        script = (ROOT / "tests/stack/inside/round_trip.py").read_bytes()
        told = docker(*client, "cpn-sim-worker", "-", json.dumps(networks), str(effort.plans), stdin=script)
    finally:
        docker("rm", "--force", router)
        docker("volume", "rm", router)
    times = {name: 1e3 * np.array(of_one) for name, of_one in json.loads(told.splitlines()[-1]).items()}
    medians = {name: np.median(of_one.reshape(-1, BLOCK), axis=1) for name, of_one in times.items()}
    ratios = medians["tls"] / medians["tcp"]
    interval = bootstrap((ratios,), np.median, rng=0).confidence_interval
    tls, tcp, ratio = (float(np.median(values)) for values in (times["tls"], times["tcp"], ratios))
    print(
        f"plan over mutual TLS {tls:.2f} ms, over TCP {tcp:.2f} ms: {ratio:.3f} times "
        f"({interval.low:.3f} to {interval.high:.3f}, n = {len(ratios)} blocks of {BLOCK} plans each)",
        flush=True,
    )
    row = Row(
        "plan's round trip over mutual TLS (a ratio of times: less is better)",
        tls,
        tcp,
        "TCP",
        ratio,
        "ms",
        len(times["tls"]),
    )
    return [row]


def main() -> None:
    """Measures everything, or what is named."""
    parts = ("start-up", "throughput", "recovery", "tls")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "runs/bench")
    parser.add_argument("--quick", action="store_true", help="a glance")
    parser.add_argument("--only", choices=parts, nargs="+", default=parts)
    options = parser.parse_args()
    if reason := engine.missing():
        parser.exit(0, f"THE STACK IS NOT MEASURED HERE: {reason}\n")
    effort = QUICK if options.quick else FULL
    rows: list[Row] = []
    if "start-up" in options.only:
        rows += start_up(effort)
    stack = Stack()
    stack.environment["CPN_HOSTS"] = "router,planner-0,planner-1,trainer,bench-router"
    try:
        stack.up()
        measures = {"throughput": throughput, "recovery": recovery, "tls": cost_of_tls}
        for part, measure in measures.items():
            if part in options.only:
                if part == "tls":
                    # Nobody else is to be served meanwhile.
                    stack.compose("stop", "planner-1", "trainer", "sim-worker")
                rows += measure(stack, effort)
    finally:
        stack.down()
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "stack.json").write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")


if __name__ == "__main__":
    main()
